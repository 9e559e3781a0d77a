"""Submaps of neighbouring keyframes: their points in one frame, and the free space that they saw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose
from impslam.recognition.free_ranges import Floats, free_ranges
from impslam.surfaces.features import Features, beam_spacing, features
from impslam.types import Array, Ints, Scan

FEATURE_SPACING = 0.04  # m between the features of a view, at least
_NONE = np.iinfo(np.int64).min  # marks an empty entry of a hash table


class View(NamedTuple):
    """The features and free space of a keyframe, in its base_link.

    Attributes
    ----------
    features : (n, 5), see `impslam.surfaces.features`
    laser : (2,) m, position of the lidar
    free : (BEARINGS,) m, free range from the lidar, 0 if unknown. Bin b begins at the direction
        -pi + b * 2 pi / BEARINGS of base_link.
    """

    features: Features
    laser: Array
    free: Floats


class Submap(NamedTuple):
    """The features and free space of several keyframes, in one frame.

    Attributes
    ----------
    features : (n, 5), at most one in each cell
    vantages : (k, 3) positions of the lidar, and headings of base_link
    free : (k, BEARINGS) m, see `View.free`
    """

    features: Features
    vantages: Array
    free: Floats

    @property
    def view_share(self) -> float:
        """The mean share of all directions that one of the scans sees."""
        return float((self.free > 0.0).mean())


def view(scan: Scan) -> View:
    """Return the view of a scan, with features at least `FEATURE_SPACING` apart.

    They are measured points: smoothed ones fit places that look alike too well.
    """
    free = free_ranges(scan.points[scan.valid], scan.laser[:2], beam_spacing(scan.angles))
    return View(features(scan, FEATURE_SPACING, smooth=False), scan.laser[:2].copy(), free)


def gather(
    views: Sequence[View], poses: Array, frame: Array, cell: float, max_range: float = math.inf
) -> Submap:
    """Return keyframes at poses (k, 3) as a submap relative to a frame (3,), all in map.

    The first feature in each cell of `cell` m is kept, up to `max_range` m from the frame.
    """
    poses = between(frame, poses)
    rows = np.concatenate([v.features for v in views])
    ends = np.cumsum([len(v.features) for v in views], dtype=np.int64)
    out = np.empty_like(rows)
    count = _merge(rows, ends, poses, cell, max_range, out)
    offsets = np.zeros((len(views), 3))
    offsets[:, :2] = [v.laser for v in views]
    return Submap(out[:count].copy(), compose(poses, offsets), np.stack([v.free for v in views]))


@kernel
def _merge(
    rows: Features, ends: Ints, poses: Array, cell: float, max_range: float, out: Features
) -> int:
    """Fill `out` with rows transformed by their keyframes' poses, one per cell; return their number."""
    size = 16
    while size < 2 * len(rows):
        size *= 2
    table = np.full(size, _NONE)
    count, i = 0, 0
    for k in range(len(ends)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        while i < ends[k]:
            row = rows[i]
            i += 1
            x, y = poses[k, 0] + c * row[0] - s * row[1], poses[k, 1] + s * row[0] + c * row[1]
            if x * x + y * y > max_range * max_range:
                continue
            if not _insert(table, math.floor(x / cell), math.floor(y / cell)):
                continue
            out[count, 0], out[count, 1], out[count, 4] = x, y, row[4]
            out[count, 2], out[count, 3] = c * row[2] - s * row[3], s * row[2] + c * row[3]
            count += 1
    return count


@kernel
def _insert(table: Ints, column: int, row: int) -> bool:
    """Insert a cell into a hash table (Teschner et al. 2003); return False if it is there already."""
    mask = len(table) - 1
    key = (column << 32) + row
    at = ((column * 73856093) ^ (row * 19349663)) & mask
    while table[at] != _NONE:
        if table[at] == key:
            return False
        at = (at + 1) & mask
    table[at] = key
    return True
