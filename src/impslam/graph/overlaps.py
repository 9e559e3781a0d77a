"""Select pairs of keyframes that have seen the same surfaces, spread over the passes of a place.

Neighbours of one pass add little that the tracker has not used already; pairs between passes prevent double
walls. So each keyframe is paired with a few of its own pass and with one of each other pass nearby.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.types import Array, Ints, check_shape

MIN_COMMON = 0.36  # share of the view of two keyframes: with less, too few points have partners


class Nearness(NamedTuple):
    """Criteria for pairs of keyframes.

    Attributes
    ----------
    distance : m, maximum; beyond, occlusions differ too much
    turn : rad, maximum; with a field of view of 180 degrees, a share of `MIN_COMMON` is common
    partners : maximum number for each keyframe; from 4 to 10 the map is the same
    same_pass : maximum number of these from the same pass
    pass_distance : m driven; keyframes closer than this along the drive are of one pass
    apart : m driven between two partners from other passes
    """

    distance: float = 3.0
    turn: float = (1.0 - MIN_COMMON) * math.pi
    partners: int = 6
    same_pass: int = 4
    pass_distance: float = 8.0
    apart: float = 3.0


HIDDEN_PER_RADIAN = 0.7  # m: a turn of a radian hides about as much as this distance


def overlaps(poses: Array, nearness: Nearness | None = None) -> Ints:
    """Return the pairs (m, 2) of keyframes i, j that overlap: the points of j fall on surfaces of i.

    `poses` (k, 3) are those of all keyframes, in the order of the drive, or of their lidars if these have
    different headings. Pairs are ordered by j, and for each j from the nearest to the farthest i. Both (i,
    j) and (j, i) may be included.
    """
    poses = plain(poses)
    check_shape("poses", poses, None, 3)
    if len(poses) < 2:
        return np.empty((0, 2), np.int64)
    step = np.diff(poses[:, :2], axis=0)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(step[:, 0], step[:, 1]))])
    nearness = Nearness() if nearness is None else nearness
    order = np.argsort(poses[:, 0], kind="stable")
    first = np.searchsorted(poses[order, 0], poses[:, 0] - nearness.distance)
    out = np.empty((len(poses) * nearness.partners, 2), np.int64)
    return out[: _overlaps(poses, driven, order, first, nearness, out)]


@kernel
def _overlaps(
    poses: Array, driven: Array, order: Ints, first: Ints, nearness: Nearness, out: Ints
) -> int:
    """Fill `out` with pairs and return the number; `order` (k,) is by x, and starts at first[j] for j."""
    near, cost, count = np.empty(len(poses), np.int64), np.empty(len(poses)), 0
    for j in range(len(poses)):
        found = _candidates(poses, order[first[j] :], j, nearness, near, cost)
        same = 0
        for _ in range(nearness.partners):
            k = np.argmin(cost[:found]) if found else 0
            if found == 0 or cost[k] == np.inf:
                break
            i = near[k]
            out[count, 0], out[count, 1] = i, j
            count += 1
            own = abs(driven[i] - driven[j]) < nearness.pass_distance
            same += own
            for q in range(found):
                if own and same >= nearness.same_pass:
                    if abs(driven[near[q]] - driven[j]) < nearness.pass_distance:
                        cost[q] = np.inf
                elif not own and abs(driven[near[q]] - driven[i]) < nearness.apart:
                    cost[q] = np.inf
            cost[k] = np.inf
    return count


@kernel
def _candidates(
    poses: Array, order: Ints, j: int, nearness: Nearness, near: Ints, cost: Array
) -> int:
    """Fill `near` with the keyframes around j and `cost` with their distances; return the number."""
    found = 0
    for i in order:
        dx, dy = poses[i, 0] - poses[j, 0], poses[i, 1] - poses[j, 1]
        if dx > nearness.distance:
            break
        distance = math.sqrt(dx * dx + dy * dy)
        if i == j or distance >= nearness.distance:
            continue
        turn = abs(wrap_in_kernel(poses[i, 2] - poses[j, 2]))
        if turn <= nearness.turn:
            near[found], cost[found] = i, distance + HIDDEN_PER_RADIAN * turn
            found += 1
    return found
