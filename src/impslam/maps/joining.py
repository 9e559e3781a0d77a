"""Two maps as one: the keyframes of the second follow those of the first, as sessions of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from impslam.estimators.pose_graph import KERNEL
from impslam.geometry.se2 import between, compose
from impslam.map import Keyframes, Map
from impslam.maps.relation import HEADING, PLACE, Link
from impslam.types import Edges, Ints, Observation


def joined(first: Map, second: Map, links: Sequence[Link]) -> Map:
    """Return both maps in one, connected by links; poses are as they are in each.

    The second one lies in the frame of the first, both have a graph, and the links' poses are in that
    frame. Landmarks are left out: two of them may be one. So is where the maps are from.
    """
    n, m = len(first.keyframes), len(first.keyframes.points)
    rows = _columns(first.keyframes, second.keyframes, starts=m)
    rows["sessions"][n:] += first.keyframes.sessions.max(initial=-1) + 1
    sweeps = _columns(first, second, anchors=n)
    edges = second.edges._replace(i=second.edges.i + n, j=second.edges.j + n)
    return Map(
        Keyframes(**rows),
        (),
        **sweeps,
        edges=first.edges.joined(edges).joined(_edges(first, second, links)),
        observations=_observations(first) + _observations(second),
    )


def _columns(first: object, second: object, **offsets: int) -> dict[str, Any]:
    """Return the arrays of two objects by name, one after the other; offsets are added to the second."""
    out = {}
    for f in fields(first):  # type: ignore[arg-type]  # both are dataclasses
        one, two = getattr(first, f.name), getattr(second, f.name)
        if isinstance(one, np.ndarray):
            if f.name in offsets:
                two = two + offsets[f.name]
            out[f.name] = np.concatenate([one, two[1:] if f.name == "starts" else two])
    return out


def _observations(known: Map) -> tuple[tuple[Observation, ...], ...]:
    return known.observations or ((),) * len(known.keyframes)


def _edges(first: Map, second: Map, links: Sequence[Link]) -> Edges:
    """Return links as closures between nodes of both graphs.

    A link is of any keyframe, and goes to the node before it; in the first map the nearest node is taken.
    """
    ours, theirs = _nodes(first), _nodes(second)
    i, j, motions = [], [], []
    for link in links:
        node = theirs[max(int(np.searchsorted(theirs, link.row, side="right")) - 1, 0)]
        poses = second.keyframes.poses
        pose = compose(link.pose, between(poses[link.row], poses[node]))
        near = first.keyframes.poses[ours]
        i.append(int(ours[np.argmin(np.hypot(near[:, 0] - pose[0], near[:, 1] - pose[1]))]))
        j.append(len(first.keyframes) + int(node))
        motions.append(between(first.keyframes.poses[i[-1]], pose))
    information = np.diag(np.array([PLACE, PLACE, HEADING]) ** -2.0)
    count = len(links)
    return Edges(
        np.array(i, np.int64),
        np.array(j, np.int64),
        np.array(motions).reshape(-1, 3),
        np.tile(information, (count, 1, 1)),
        np.full(count, KERNEL),
    )


def _nodes(known: Map) -> Ints:
    """Return the keyframes that are nodes of a map's graph and placed in it."""
    nodes = np.unique(np.concatenate([known.edges.i, known.edges.j, [0]]))
    return np.asarray(nodes[known.keyframes.placed[nodes]])
