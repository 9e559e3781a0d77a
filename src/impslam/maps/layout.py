"""The arrays in a map's file by version, and their validation."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from impslam.geometry.se2 import between
from impslam.maps.archive import Arrays, Layout
from impslam.maps.observations import packed, unpacked
from impslam.types import (
    NO_COVARIANCE,
    NO_EDGES,
    Array,
    Edges,
    Ints,
    Landmark,
    Observation,
    check_shape,
)

_ROWS: Layout = {
    "stamps": ("f8", ("sweeps",)),
    "anchors": ("i8", ("sweeps",)),
    "T_anchor_base": ("f8", ("sweeps", 3)),
    "track_covariances": ("f8", ("sweeps", 6)),
    "odometry_poses": ("f8", ("sweeps", 3)),
    "live_poses": ("f8", ("sweeps", 3)),
}
_KEYFRAMES: Layout = {
    "keyframes/stamps": ("f8", ("keyframes",)),
    "keyframes/poses": ("f8", ("keyframes", 3)),
    "keyframes/covariances": ("f8", ("keyframes", 3, 3)),
    "keyframes/innovations": ("f8", ("keyframes", 3)),
    "keyframes/origins": ("f8", ("keyframes", 2)),
    "keyframes/starts": ("i8", ("starts",)),
    "keyframes/points": ("f4", ("points", 2)),
}
_LANDMARKS: Layout = {"landmarks": ("u1", ("bytes",))}  # JSON
_EDGES: Layout = {
    "edges/i": ("i8", ("edges",)),
    "edges/j": ("i8", ("edges",)),
    "edges/T_i_j": ("f8", ("edges", 3)),
    "edges/information": ("f8", ("edges", 3, 3)),
    "edges/kernel": ("f8", ("edges",)),
}
_DRIVE: Layout = {
    "tracked": ("f8", ("sweeps", 3)),
    "keyframes/motions": ("f8", ("keyframes", 3)),
    "keyframes/motion_covariances": ("f8", ("keyframes", 3, 3)),
    "keyframes/sessions": ("i8", ("keyframes",)),
    "keyframes/placed": ("b1", ("keyframes",)),
}
_OBSERVATIONS: Layout = {
    "observations/counts": ("i8", ("counts",)),  # one for each keyframe, or none
    "observations/kinds": ("i8", ("observations",)),
    "observations/sizes": ("i8", ("observations",)),
    "observations/z": ("f8", ("z",)),
    "observations/R": ("f8", ("R",)),
    "observations/end_points": ("f8", ("observations", 2, 2)),
    "observations/labels": ("i8", ("observations",)),
    "observations/delays": ("f8", ("observations",)),
    "observations/attributes": ("f8", ("attributes",)),
    "observations/names": ("u1", ("names",)),  # JSON
}
_JOINT: Layout = {"landmark_covariance": ("f8", ("landmark_values", "landmark_values"))}
MOTION_SIGMA = np.array([0.03, 0.03, 0.01])
"""m, m, rad of the motion to a keyframe if a map lacks it: dead reckoning over half a metre."""


def layout(version: int) -> Layout:
    """Return the arrays in files of a version.

    Version 2 adds edges; 3 adds what is needed to continue a map: motions, sessions, observations; 4 adds
    the joint covariance of the landmarks.
    """
    known = {**_ROWS, **_KEYFRAMES, **_LANDMARKS}
    if version > 1:
        known |= _EDGES
    if version > 2:
        known |= {**_DRIVE, **_OBSERVATIONS}
    if version > 3:
        known |= _JOINT
    return known


def to_arrays(
    columns: Mapping[str, Any],
    keyframes: Mapping[str, Any],
    landmarks: Sequence[Landmark],
    edges: Edges,
    observations: Sequence[Sequence[Observation]],
) -> Arrays:
    """Return the arrays of a map's file."""
    marks = json.dumps([asdict(m) for m in landmarks], default=lambda array: array.tolist())
    return {
        **{name: columns[name] for name in (*_ROWS, "tracked", *_JOINT)},
        **{f"keyframes/{name}": array for name, array in keyframes.items()},
        **{f"edges/{name}": array for name, array in edges._asdict().items()},
        **{f"observations/{name}": array for name, array in packed(observations).items()},
        "landmarks": np.frombuffer(marks.encode(), np.uint8),
    }


def from_arrays(arrays: Arrays) -> dict[str, Any]:
    """Return the parts of a map by name, those of "keyframes" in a table.

    Raises ValueError if arrays are inconsistent, because compiled code does not check indices.
    """
    parts: dict[str, Any] = {name: arrays[name] for name in _ROWS}
    keyframes = _part(arrays, "keyframes/")
    _check_points(keyframes)
    _check_finite(keyframes, "poses", "covariances", "origins", "points")
    if ((arrays["anchors"] < 0) | (arrays["anchors"] >= len(keyframes["stamps"]))).any():
        raise ValueError("anchors are not keyframes")
    marks = tuple(_landmark(m) for m in json.loads(arrays["landmarks"].tobytes()))
    parts |= {"landmarks": marks, "keyframes": keyframes}
    parts["edges"] = _edges(arrays, len(keyframes["stamps"]))
    if "tracked" in arrays:
        _check_sessions(keyframes["sessions"])
        _check_covariances("keyframes/motion_covariances", keyframes["motion_covariances"])
        seen = unpacked(_part(arrays, "observations/"))
        if len(seen) not in (0, len(keyframes["stamps"])):
            raise ValueError("observations/counts does not fit the keyframes")
        parts |= {"observations": seen, "landmark_covariance": _joint(arrays, len(marks))}
        return {**parts, "tracked": arrays["tracked"]}
    keyframes |= undriven(keyframes["poses"])
    return {**parts, "tracked": arrays["T_anchor_base"]}


def _joint(arrays: Arrays, landmarks: int) -> Array:
    """Return the joint covariance of the landmarks, which may be empty; raise ValueError if invalid."""
    joint = arrays.get("landmark_covariance", NO_COVARIANCE)
    if len(joint) not in (0, 2 * landmarks):
        raise ValueError("landmark_covariance does not fit the landmarks")
    if not np.isfinite(joint).all():
        raise ValueError("landmark_covariance is not finite")
    return joint


def undriven(poses: Array) -> Arrays:
    """Return the further columns of keyframes with only known poses (k, 3)."""
    k = len(poses)
    motions = np.concatenate([poses[:1], between(poses[:-1], poses[1:])])
    return {
        "motions": motions,
        "motion_covariances": np.broadcast_to(np.diag(MOTION_SIGMA**2), (k, 3, 3)).copy(),
        "sessions": np.zeros(k, np.int64),
        "placed": np.ones(k, np.bool_),
    }


def _part(arrays: Arrays, prefix: str) -> Arrays:
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}


def _check_points(keyframes: Arrays) -> None:
    starts, k = keyframes["starts"], len(keyframes["stamps"])
    if len(starts) != k + 1 or starts[0] != 0 or starts[-1] != len(keyframes["points"]):
        raise ValueError("keyframes/starts does not fit the points")
    if (np.diff(starts) < 0).any():
        raise ValueError("keyframes/starts decreases")


def _check_finite(keyframes: Arrays, *names: str) -> None:
    for name in names:
        if not np.isfinite(keyframes[name]).all():
            raise ValueError(f"keyframes/{name} is not finite")


def _check_covariances(name: str, covariances: Array) -> None:
    """Raise ValueError for finite matrices (k, 3, 3) that are not covariances."""
    finite = covariances[np.isfinite(covariances).all(axis=(1, 2))]
    rounding = 1e-9 * np.abs(finite).max(initial=0.0)
    if len(finite) and (
        np.abs(finite - finite.swapaxes(1, 2)).max() > rounding
        or np.linalg.eigvalsh(finite).min() < -rounding
    ):
        raise ValueError(f"{name} are not covariances")


def _check_sessions(sessions: Ints) -> None:
    """Raise ValueError unless sessions are numbered 0, 1, ... in the order of keyframes."""
    if len(sessions) and (sessions[0] != 0 or not np.isin(np.diff(sessions), (0, 1)).all()):
        raise ValueError("keyframes/sessions do not count up")


def _edges(arrays: Arrays, keyframes: int) -> Edges:
    """Return the edges; raise ValueError for invalid ones."""
    if "edges/i" not in arrays:
        return NO_EDGES
    edges = Edges(*(arrays[f"edges/{name}"] for name in Edges._fields))
    ends = np.stack([edges.i, edges.j])
    if ((ends < 0) | (ends >= keyframes)).any() or (edges.i == edges.j).any():
        raise ValueError("edges do not join two keyframes")
    if not (np.isfinite(edges.T_i_j).all() and np.isfinite(edges.information).all()):
        raise ValueError("edges are not finite")
    if not (edges.kernel > 0.0).all():
        raise ValueError("edges/kernel is not positive")
    return edges


def _landmark(mark: dict[str, Any]) -> Landmark:
    known = Landmark(**mark)
    position, covariance = (np.array(v, np.float64) for v in (known.position, known.covariance))
    ends = known.end_points if known.end_points is None else np.array(known.end_points, np.float64)
    check_shape("position", position, 2)
    check_shape("covariance", covariance, len(covariance), len(covariance))
    if ends is not None:
        check_shape("end_points", ends, 2, 2)
    if not isinstance(known.kind, str) or not isinstance(known.parameters, dict):
        raise TypeError("a landmark has no kind, or no parameters")
    return replace(
        known,
        id=int(known.id),
        observations=int(known.observations),
        first_stamp=float(known.first_stamp),
        last_stamp=float(known.last_stamp),
        position=position,
        covariance=covariance,
        end_points=ends,
    )
