"""The systematic errors of odometry's turns, which wheels and gyro share, over a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.noise import SystematicErrors
from impslam.types import Array, Ints

KEPT = 2000
"""Rows of odometry that are kept beyond a batch: 10 s at 200 Hz. Sweeps wait for at most 25 rows of the
log, for their delay, or for that of another sensor."""


class TurnErrors:
    """Stores the gyro's share in the newest motions, and the standard deviation of its bias."""

    def __init__(self, wheels: SystematicErrors | None, gyro_scale: float) -> None:
        """`wheels` are the errors of the wheels, if there are any; `gyro_scale` is relative."""
        self._wheels, self._gyro_scale = wheels, gyro_scale
        self._order, self._shares = np.empty(0, np.int64), np.empty((0, 2))
        self._last = -1
        """Position in the log of the newest sweep."""

    def add(self, order: Ints, shares: Array) -> None:
        """Add motions at positions in the log (m,), with their (m, 2) of `GyroFusion.correct`."""
        self._order = np.concatenate([self._order[-KEPT:], order])
        self._shares = np.concatenate([self._shares[-KEPT:], shares])

    def at(self, order: Ints) -> Sequence[SystematicErrors | None]:
        """Return the errors at sweeps with these positions in the log; None: none.

        They are those of the newest motion, but the turn is that of the wheels alone if the gyro did not
        measure all of it since the sweep before.
        """
        if not len(order):
            return []
        motions = np.searchsorted(self._order, np.append(self._last, order))
        self._last = int(order[-1])
        unmeasured = np.append(0, np.cumsum(np.isnan(self._shares[:, 0])))[motions]
        by_wheels = np.diff(unmeasured) > 0
        return [self._of(k, w) for k, w in zip(motions[1:] - 1, by_wheels, strict=True)]

    def _of(self, motion: int, by_wheels: bool) -> SystematicErrors | None:
        share, bias = self._shares[motion].tolist() if motion >= 0 else (0.0, 0.0)
        if not bias:
            return self._wheels
        wheels = self._wheels or SystematicErrors(0.0, 0.0)
        share = 0.0 if by_wheels else share
        return wheels._replace(gyro_scale=self._gyro_scale, gyro_bias=bias, gyro_share=share)
