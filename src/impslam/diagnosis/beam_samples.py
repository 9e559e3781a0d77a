"""Scans to check beams with: evenly spread over a log, of one layout, with ranges as received."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath, unmounted
from impslam.columns import Columns
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Mask

MAX_SCANS, MIN_SCANS = 400, 10
"""Scans that are checked, and the least number of them."""


class BeamSamples(NamedTuple):
    """Samples of scans.

    `ranges` (m, n) as received, `valid` (m, n) by the config, `angles` (n,) rad, `headings` (m,) rad along
    the path of the lidar; `limit` m, the largest valid range, inf without one.
    """

    ranges: Array
    valid: Mask
    angles: Array
    headings: Array
    limit: float = np.inf


def beam_samples(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath) -> BeamSamples | None:
    """Return scans evenly spread over the longest piece of one layout; None if there are too few."""
    lengths = [len(piece) for piece in scans]
    if max(lengths, default=0) < MIN_SCANS:
        return None
    longest = int(np.argmax(lengths))
    piece, start = scans[longest], sum(lengths[:longest])
    rows = np.unique(np.linspace(0, len(piece) - 1, min(MAX_SCANS, len(piece))).astype(np.int64))
    piece, headings = piece.take(rows), path.poses[start + rows, 2]
    seen = unmounted(lidar).sweeps(piece, np.zeros((len(rows), 3)))
    return BeamSamples(piece["ranges"], seen.valid, piece["angles"], headings, seen.range_max)
