"""What a scan of a SCIP sensor holds: which beams, where they look, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.platform.devices import scip
from impslam.platform.devices.scip import Mode, Sweep
from impslam.platform.devices.scip_info import Parameters
from impslam.types import Array, LaserScan

SATURATED = 4095  # mm: two characters say no more, and this for all that is beyond


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """The n beams of a scan, each of `cluster` neighbouring steps.

    Attributes
    ----------
    mode : the command that asks for them
    request : that command in full
    angles : (n,) rad, counter-clockwise seen from above, 0 straight on
    offsets : (n,) s after the first beam
    delay : s from step 0, which the sensor stamps, to the first beam
    limits : mm, smaller and larger values are no distances
    """

    mode: Mode
    request: bytes
    angles: Array
    offsets: Array
    delay: float
    limits: tuple[int, int]

    @classmethod
    def of(
        cls, known: Parameters, mode: Mode, span: tuple[int, int], cluster: int, skip: int
    ) -> Beams:
        """Lay out the steps from the first to the last of `span`; a beam is amid its cluster."""
        first, last = span
        starts = np.arange(first, last + 1, cluster, dtype=np.float64)
        middles = 0.5 * (starts + np.minimum(starts + cluster - 1, last))
        longest = min(known.longest, SATURATED - 1) if scip.WIDTH[mode] == 2 else known.longest
        return cls(
            mode=mode,
            request=scip.measure(mode, first, last, cluster, skip),
            angles=(middles - known.front) * known.step_angle,
            offsets=(middles - middles[0]) * known.step_time,
            delay=float(middles[0]) * known.step_time,
            limits=(known.shortest, longest),
        )

    @property
    def echo(self) -> str:
        """What its responses begin with."""
        return self.request.decode("ascii").rstrip("\n")

    @property
    def characters(self) -> int:
        """Bytes of a response: echo, status, stamp, and data with a checksum a line."""
        data = len(self.angles) * scip.WIDTH[self.mode]
        return len(self.request) + 4 + 6 + data + 2 * -(-data // scip.BLOCK) + 1

    def read(self, response: scip.Response) -> Sweep:
        """Return the scan that a response carries, whole or not at all.

        Raises
        ------
        DamagedError
            If anything of it is damaged.
        """
        return scip.sweep(response, scip.WIDTH[self.mode], len(self.angles))

    def to_scan(self, sweep: Sweep, step_0: float) -> LaserScan:
        """Return a scan whose step 0 was at a time; beams that measured nothing have range 0."""
        shortest, longest = self.limits
        return LaserScan(
            step_0 + self.delay,
            self.angles,
            scip.to_metres(sweep.values, shortest, longest),
            self.offsets,
            1e-3 * shortest,
            1e-3 * longest,
        )
