"""Join two maps: the keyframes of the second follow those of the first, as separate sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from impslam.estimators.pose_graph import KERNEL
from impslam.geometry.se2 import between, compose
from impslam.map import Keyframes, Map
from impslam.maps.relation import HEADING_SIGMA, POSITION_SIGMA, SegmentMatch
from impslam.types import NO_COVARIANCE, Edges, Ints, Observation


def joined(first: Map, second: Map, links: Sequence[SegmentMatch]) -> Map:
    """Return both maps as one, connected by links, with unchanged poses.

    The second map and the poses of the links must be in the frame of the first, and both must have a graph.
    Landmarks are left out because they may be duplicates, and so is the origin of the maps.
    """
    n, m = len(first.keyframes), len(first.keyframes.points)
    first, second = (replace(m, landmark_covariance=NO_COVARIANCE) for m in (first, second))
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
    """Concatenate the arrays of two objects by name; offsets are added to those of the second."""
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


def _edges(first: Map, second: Map, links: Sequence[SegmentMatch]) -> Edges:
    """Return links as closures between nodes of both graphs.

    They connect the node before the keyframe of the link with the nearest node of the first map.
    """
    first_nodes, second_nodes = _nodes(first), _nodes(second)
    i, j, motions = [], [], []
    for link in links:
        node = second_nodes[max(int(np.searchsorted(second_nodes, link.row, side="right")) - 1, 0)]
        poses = second.keyframes.poses
        pose = compose(link.pose, between(poses[link.row], poses[node]))
        near = first.keyframes.poses[first_nodes]
        i.append(int(first_nodes[np.argmin(np.hypot(near[:, 0] - pose[0], near[:, 1] - pose[1]))]))
        j.append(len(first.keyframes) + int(node))
        motions.append(between(first.keyframes.poses[i[-1]], pose))
    information = np.diag(np.array([POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA]) ** -2.0)
    count = len(links)
    return Edges(
        np.array(i, np.int64),
        np.array(j, np.int64),
        np.array(motions).reshape(-1, 3),
        np.tile(information, (count, 1, 1)),
        np.full(count, KERNEL),
    )


def _nodes(known: Map) -> Ints:
    """Return the placed keyframes that are nodes of a map's graph."""
    nodes = np.unique(np.concatenate([known.edges.i, known.edges.j, [0]]))
    return np.asarray(nodes[known.keyframes.placed[nodes]])
