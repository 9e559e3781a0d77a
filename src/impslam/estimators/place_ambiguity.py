"""Whether a scan may show another place than that of the estimate, after a gap in the data.

After the gap, the robot may be anywhere that it can have driven to. Matching begins at the predicted pose,
and takes the place that fits there. The map then shows whether another place within reach explains the scan
as well, such as the next room of a hotel.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from impslam.estimators.base import MIN_SIGMA
from impslam.estimators.keyframe_log import KeyframeLog, revised
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import GATE_3D_999
from impslam.geometry.se2 import between, compose
from impslam.health import ELSEWHERE
from impslam.map import REACH_SIGMAS, Keyframe
from impslam.recognition.beams import Explanation
from impslam.recognition.submap import view
from impslam.types import Array

if TYPE_CHECKING:
    from impslam.recognition.relocalisation import Relocaliser

MAX_DISTANCE2 = GATE_3D_999
"""Squared Mahalanobis distance: nearer places are within the covariance of the estimate, as along a bare
corridor."""
MIN_SHIFT = 0.5
"""m between the estimate and another place; nearer ones are the same, aligned a little differently."""


def fits_elsewhere(before: Array, keyframe: Keyframe, keys: KeyframeLog, graph: PoseGraph) -> bool:
    """Return whether a new keyframe fits the map at another place within its reach as well.

    Another place counts if it is probable enough for relocalisation to be ambiguous. `before` (3,) is the
    pose of the keyframe before it in the map.
    """
    from impslam.recognition.relocalisation import (  # noqa: PLC0415  few runs need it
        EVIDENCE,
        FOUND_PROBABILITY,
        Near,
        query,
    )

    motion, (radius, turn) = keyframe.motion, keyframe.reach
    pose = compose(before, motion.d_pose)
    if keyframe.scan is None or (finder := _surroundings(pose, radius, keys, graph)) is None:
        return False
    scans = query([view(keyframe.scan)], np.zeros((1, 3)))
    here = finder.align(scans, pose)
    information = np.linalg.inv(motion.covariance + MIN_SIGMA**2 * np.eye(3))
    least = _score(finder.explain(scans, here)) + math.log(1.0 - FOUND_PROBABILITY) / EVIDENCE
    for place in finder.find_query(scans, Near(pose, radius)).hypotheses:
        off = between(before, place.pose) - motion.d_pose
        off[2] = wrap(off[2])
        is_other = off @ information @ off > MAX_DISTANCE2 and abs(off[2]) <= turn
        is_other &= math.dist(place.pose[:2], here[:2]) >= MIN_SHIFT
        if is_other and _score(finder.explain(scans, place.pose)) > least:
            return True
    return False


def as_session_start(keyframe: Keyframe) -> Keyframe:
    """Return a keyframe that begins a session, with a motion as uncertain as its reach."""
    sigmas = np.array(keyframe.reach)[[0, 0, 1]] / REACH_SIGMAS
    covariance = keyframe.motion.covariance + np.diag(sigmas**2)
    motion = replace(keyframe.motion, covariance=covariance)
    return replace(keyframe, motion=motion, lost=True, reason=ELSEWHERE)


def _score(explanation: Explanation) -> float:
    """Return the mean score of the beams that end where the map has been seen: new ground says nothing."""
    return explanation.score / max(1.0 - explanation.unknown, 1e-9)


def _surroundings(
    pose: Array, reach: float, keys: KeyframeLog, graph: PoseGraph
) -> Relocaliser | None:
    """Return a finder in the part of the map that is visible from within `reach` m of a pose (3,).

    None if no part is.
    """
    from impslam.recognition.relocalisation import MAX_RANGE, Relocaliser  # noqa: PLC0415

    poses = revised(keys, graph)
    near = np.hypot(*(poses[:, :2] - pose[:2]).T) <= reach + MAX_RANGE
    near &= keys.has_view & (graph.roots[keys.node_before] == 0)
    return Relocaliser(keys.keyframes(poses, np.flatnonzero(near))) if near.any() else None
