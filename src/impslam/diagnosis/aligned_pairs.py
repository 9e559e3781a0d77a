"""Pairs of scans, aligned once for all checks that compare them."""

from __future__ import annotations

from collections.abc import Sequence

from impslam.calibration.lidar_path import LidarPath
from impslam.calibration.scan_pairs import AlignedPair, align_pairs
from impslam.columns import Columns
from impslam.sensors.lidar2d import Lidar2D

MAX_PAIRS, MIN_PAIRS = 100, 12
"""Pairs that are compared, which determine the offset of ranges to some mm in rooms, in tenths of a second
of computing; and the least number, twice the rows that the robust scale can be wrong about."""


class AlignedPairs:
    """The pairs of scans along a lidar's path; the newest alignment is kept for other checks."""

    def __init__(self, scans: Sequence[Columns], path: LidarPath) -> None:
        self._scans, self._path = scans, path
        self._newest: tuple[Lidar2D, list[AlignedPair]] | None = None

    def by(self, lidar: Lidar2D) -> list[AlignedPair]:
        """Return the pairs as scans of a lidar with these parameters."""
        if self._newest is None or self._newest[0] != lidar:
            aligned = align_pairs(lidar, self._scans, self._path, MAX_PAIRS)
            self._newest = lidar, aligned
        return self._newest[1]
