"""The beams of a scan of a SCIP sensor: angles, times and limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.platform.devices import scip
from impslam.platform.devices.scip import Mode, Sweep
from impslam.platform.devices.scip_info import MeasurementParameters
from impslam.types import Array, LaserScan

SATURATED = 4095  # mm: the largest value of two characters, sent for all larger distances


@dataclass(frozen=True, slots=True, eq=False)
class UrgBeams:
    """The n beams of a scan, each of `cluster` neighbouring steps.

    Attributes
    ----------
    mode : the command that requests them
    request : that command in full
    angles : (n,) rad, counter-clockwise seen from above, 0 forward
    offsets : (n,) s after the first beam
    delay : s from step 0, which the sensor stamps, to the first beam
    limits : valid distances, mm
    """

    mode: Mode
    request: bytes
    angles: Array
    offsets: Array
    delay: float
    limits: tuple[int, int]

    @classmethod
    def of(
        cls,
        parameters: MeasurementParameters,
        mode: Mode,
        span: tuple[int, int],
        cluster: int,
        skip: int,
    ) -> UrgBeams:
        """Return the beams of the steps of `span`, each in the middle of its cluster."""
        first, last = span
        starts = np.arange(first, last + 1, cluster, dtype=np.float64)
        middles = 0.5 * (starts + np.minimum(starts + cluster - 1, last))
        limit = (
            min(parameters.longest, SATURATED - 1) if scip.WIDTH[mode] == 2 else parameters.longest
        )
        return cls(
            mode=mode,
            request=scip.measure(mode, first, last, cluster, skip),
            angles=(middles - parameters.front) * parameters.step_angle,
            offsets=(middles - middles[0]) * parameters.step_time,
            delay=float(middles[0]) * parameters.step_time,
            limits=(parameters.shortest, limit),
        )

    @property
    def echo(self) -> str:
        """The first line of its responses."""
        return self.request.decode("ascii").rstrip("\n")

    @property
    def characters(self) -> int:
        """Bytes of a response: echo, status, stamp, and data with a checksum a line."""
        data = len(self.angles) * scip.WIDTH[self.mode]
        return len(self.request) + 4 + 6 + data + 2 * -(-data // scip.BLOCK) + 1

    def read(self, response: scip.Response) -> Sweep:
        """Return the scan in a response.

        Raises
        ------
        DamagedError
            If any part of it is damaged.
        """
        return scip.sweep(response, scip.WIDTH[self.mode], len(self.angles))

    def to_scan(self, sweep: Sweep, step_0: float) -> LaserScan:
        """Return a scan with step 0 at a time; beams without a measurement have range 0."""
        shortest, limit = self.limits
        return LaserScan(
            step_0 + self.delay,
            self.angles,
            scip.to_metres(sweep.values, shortest, limit),
            self.offsets,
            1e-3 * shortest,
            1e-3 * limit,
        )
