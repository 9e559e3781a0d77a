"""Score of a scan at a pose in a map, beam by beam.

A beam that ends on a wall supports the pose. One that would have passed through a wall contradicts it; one
that ends in free space contradicts it less, because the object there may be new. One that ends in unknown
space has no effect (the beam model of Thrun et al. 2005, 6.3, with its four causes). Neither has a single
point in free space: most beams pass the legs of chairs, so the map hardly shows them, and a beam that hits
a leg and the wall behind it measures a range in between.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel, plain
from impslam.recognition.pyramid import Bytes
from impslam.recognition.search_map import FREE, SIDE, SOLID, Floats, SearchMap
from impslam.types import Array, Mask

SIGMA = 0.08  # m, of a beam's end from the wall: range noise, cells of 5 cm, error of the map
MAX_DISTANCE, MATCH_DISTANCE = 0.3, 0.12  # m from a wall, for a positive score, and for a match
SHORT_SCORE, THROUGH_SCORE = -1.0, -2.0
"""Scores of an end in free space, and of a beam through a wall. In recorded buildings, these are 4 and 2 %
of the beams at true poses, and 16 and 14 % at the best false ones: they are more informative than matches,
of which there are 92 and 68 %, and walls more than objects that may be new."""
MAX_MISFIT = 0.15
"""Share of the beams of a drive that contradict the map of its place. It was 1 to 11 % in recorded and
simulated buildings, some with furniture moved, and 19 to 24 % on floors with equal corridors, but other
rooms."""
END_MARGIN = 0.35  # m before the end of a beam that is not tested for walls
MIN_STEP = 0.04  # m along a beam
MIN_RANGE = 0.1  # m; nearer is the robot itself


class Beams(NamedTuple):
    """Beams in one frame.

    Attributes
    ----------
    starts : (n, 2) m, position of the lidar
    ends : (n, 2) m
    is_single : (n,) whether no neighbour ends on the same surface
    """

    starts: Array
    ends: Array
    is_single: Mask


class Explanation(NamedTuple):
    """Result of `explain`: the mean score, at most 1, and shares of the beams.

    Attributes
    ----------
    matched : that end on a wall
    through : that would have passed through a wall
    short : that end in free space
    unknown : that end in unknown space
    """

    score: float
    matched: float
    through: float
    short: float
    unknown: float

    @property
    def contradicting(self) -> float:
        """Share of the beams that contradict the map."""
        return self.through + self.short

    @property
    def known(self) -> float:
        """Share of the beams of which the map tells whether they fit."""
        return 1.0 - self.unknown


def explain(search_map: SearchMap, beams: Beams, pose: Array) -> Explanation:
    """Return how well a map explains beams whose frame is at a pose (3,)."""
    sums = np.zeros(5)
    _explain(search_map.state, search_map.distance, search_map.corner, beams, plain(pose), sums)
    return Explanation(*(sums / max(len(beams.ends), 1)).tolist())


@kernel
def _explain(
    state: Bytes, distance: Floats, corner: Array, beams: Beams, pose: Array, sums: Array
) -> None:
    """Add up score, and beams matched, through, short and unknown."""
    height, width = state.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(beams.ends)):
        x, y = beams.starts[i]
        x, y = pose[0] + c * x - s * y - corner[0], pose[1] + s * x + c * y - corner[1]
        dx, dy = beams.ends[i] - beams.starts[i]
        dx, dy = c * dx - s * dy, s * dx + c * dy
        if _passes(state, distance, x, y, dx, dy):
            sums[0] += THROUGH_SCORE
            sums[2] += 1.0
            continue
        column, row = math.floor((x + dx) / SIDE), math.floor((y + dy) / SIDE)
        if not (0 <= column < width and 0 <= row < height):
            sums[4] += 1.0
            continue
        d = distance[row, column]
        if d < MAX_DISTANCE:
            sums[0] += math.exp(-d * d / (2.0 * SIGMA * SIGMA))
        elif state[row, column] == FREE and not beams.is_single[i]:
            sums[0] += SHORT_SCORE
        if d < MATCH_DISTANCE:
            sums[1] += 1.0
        elif state[row, column] == FREE:
            sums[3] += 1.0
        else:
            sums[4] += 1.0


@kernel
def _passes(state: Bytes, distance: Floats, x: float, y: float, dx: float, dy: float) -> bool:
    """Return whether a beam from (x, y) m on the grid by (dx, dy) m would pass through a wall."""
    height, width = state.shape
    length = math.sqrt(dx * dx + dy * dy)
    dx, dy = dx / max(length, MIN_RANGE), dy / max(length, MIN_RANGE)
    r = MIN_RANGE
    while r < length - END_MARGIN:
        column, row = math.floor((x + r * dx) / SIDE), math.floor((y + r * dy) / SIDE)
        if not (0 <= column < width and 0 <= row < height):
            return False
        if state[row, column] == SOLID:
            return True
        r += max(distance[row, column] - MIN_STEP, MIN_STEP)
    return False
