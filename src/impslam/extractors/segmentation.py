"""Segment scans for geometric extractors: valid points in beam order, split at the ends of surfaces.

A full-turn scan is a ring: it is cut at its widest gap, so that a wall
across the first beam is not split.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import beam_spacing
from impslam.types import Array, Ints, Mask, Scan

WALL_INCIDENCE = math.radians(10.0)  # below 10 deg of incidence, range noise dominates the spacing
OBJECT_INCIDENCE = math.radians(25.0)  # a steeper step between points is the edge of an object
_MAX_HOLE = math.radians(5.0)  # a wider run of lost beams may hide anything
_HOLE_SLOPE = 2.0  # across lost beams the incidence is assumed to be at least 30 deg
NOISE_SIGMAS = 3.0  # standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedScan:
    """Valid points of a scan in beam order, cut into segments.

    Attributes
    ----------
    index : (m,) beam of each point
    points, beams : (m, 2) m, and unit vectors of the beams' directions, in base_link
    ranges, variances : (m,) m and m^2
    starts : (k + 1,) segment s holds the points starts[s] to starts[s + 1] - 1
    """

    index: Ints
    points: Array
    beams: Array
    ranges: Array
    variances: Array
    starts: Ints


@kernel
def _gap_ratios(
    points: Array, angles: Array, ranges: Array, variances: Array, spacing: float, grazing: float
) -> Array:
    """Return each point's distance to the next (cyclic), divided by the largest on one surface.

    A surface at incidence `grazing` spreads neighbours over r spacing / sin(grazing)
    (Borges and Aldon 2004, adaptive breakpoint detector), plus the noise of both.
    """
    n = len(ranges)
    out = np.empty(n)
    max_hole = max(_MAX_HOLE, 2.5 * spacing)
    for i in range(n):
        j = (i + 1) % n
        turn = abs(wrap_in_kernel(angles[j] - angles[i]))
        if turn > max_hole:
            out[i] = math.inf
            continue
        lost = max(0.0, turn - spacing)
        expected = min(ranges[i], ranges[j]) * (spacing / math.sin(grazing) + _HOLE_SLOPE * lost)
        noise = NOISE_SIGMAS * math.sqrt(variances[i] + variances[j])
        distance = math.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
        out[i] = distance / (expected + noise)
    return out


@kernel
def _cut_ring(ratios: Array, ranges: Array) -> tuple[Ints, Ints]:
    """Return the order of the points after cutting the ring, and the starts of segments in it.

    It is cut after the widest gap, or, in a closed convex room, at a corner: the farthest point.
    """
    n = len(ratios)
    last = np.argmax(ratios)
    if not ratios[last] > 1.0:
        last = np.argmax(ranges)
    order, starts = np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    count = 1
    for i in range(n):
        order[i] = (last + 1 + i) % n
        if ratios[order[i]] > 1.0 or i == n - 1:
            starts[count] = i + 1
            count += 1
    return order, starts[:count]


@kernel
def _build_cloud(
    columns: tuple[Array, Array, Array, Array],
    points: Array,
    valid: Mask,
    spacing: float,
    grazing: float,
) -> tuple[Ints, Array, Array, Array, Array, Ints]:
    """Return the fields of a `SegmentedScan`; columns are angles, directions, ranges and sigmas (n,)."""
    angles, directions, ranges, sigmas = columns
    index = np.flatnonzero(valid)
    starts = np.array([0, len(index)])
    if len(index) > 1:
        point_ranges, variances = ranges[index], sigmas[index] ** 2
        ratios = _gap_ratios(
            points[index], angles[index], point_ranges, variances, spacing, grazing
        )
        order, starts = _cut_ring(ratios, point_ranges)
        index = index[order]
    beams = np.empty((len(index), 2))
    for i in range(len(index)):
        direction = directions[index[i]]
        beams[i, 0], beams[i, 1] = math.cos(direction), math.sin(direction)
    return index, points[index], beams, ranges[index], sigmas[index] ** 2, starts


def segment(scan: Scan, grazing: float = WALL_INCIDENCE) -> SegmentedScan:
    """Return the valid points of a scan, split at gaps that no surface at incidence `grazing` explains.

    Computed once for all extractors of the scan.
    """
    return scan.derive(_segment, grazing)


def _segment(scan: Scan, grazing: float) -> SegmentedScan:
    return SegmentedScan(
        *_build_cloud(
            (scan.angles, scan.directions, scan.ranges, scan.sigmas),
            scan.points,
            scan.valid,
            beam_spacing(scan.angles),
            grazing,
        )
    )
