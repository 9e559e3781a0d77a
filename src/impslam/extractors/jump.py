"""Cylinders as jumps of the range (thesis 4.1.2), with the drawbacks described there."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.readings import usable
from impslam.geometry.angles import wrap
from impslam.geometry.polar import to_cartesian
from impslam.types import Array, Observation, Scan


def derivative(angles: Array, ranges: Array) -> Array:
    """Return (n - 1,) dr/d(angle) from each beam to the next, m/rad, along increasing beam index.

    Clockwise beams give the same signs, so a fall always begins an object; two beams at
    one angle give 0.
    """
    steps = np.abs(np.diff(angles))
    return np.divide(np.diff(ranges), steps, out=np.zeros(len(steps)), where=steps > 0.0)


def candidates(slope: Array, threshold: float) -> list[tuple[int, int]]:
    """Return the first and last beam of every object: a fall of the range, then a rise.

    `slope` (n - 1,) is that of the ranges and `threshold` its least size at an edge, both in m/rad.
    A second fall before the rise restarts the object, nearer to the laser; a rise without a fall
    before it is ignored.
    """
    objects: list[tuple[int, int]] = []
    begin = -1
    for i in np.flatnonzero(np.abs(slope) > threshold):
        if slope[i] < 0.0:
            begin = int(i) + 1
        elif begin >= 0:
            objects.append((begin, int(i)))
            begin = -1
    return objects


@register("jump")
class Jump(Extractor):
    """Cylinders where the range falls and rises by jumps (thesis 4.1.2).

    An object begins where the derivative of the range by the angle is below -threshold and ends
    where it is above +threshold; its bearing is midway between the two readings, its surface at the
    range of the reading there. The thesis stops at the surface; here the known radius is added
    along the beam, since the landmark is the axis.

    Beams without return count as range 0, as in the thesis. This causes the drawback described
    there: a gap looks like an object, which is dropped because it has no range in its
    middle, and a cylinder beside a gap is missed. An object across the ends of a full-turn
    scan is missed, too.
    """

    landmark: ClassVar[str] = "cylinder"

    threshold: float = parameter(
        50.0,
        "m/rad",
        "jump of the range per angle that bounds an object: 0.3 m between two beams of a "
        "URG-04LX (0.352 deg), twice what a wall 4 m away shows at 80 deg incidence (4 tan 80 deg)",
        gt=0.0,
    )
    radius: float = parameter(
        0.1524, "m", "known radius of the cylinders (6 in, thesis 5.2.1)", ge=0.0
    )
    sigma_range: float = parameter(
        0.03,
        "m",
        "standard deviation of the distance, thesis Eq. 4.9: one reading of a URG-04LX in the "
        "middle of its range (1 % of 3 m)",
        gt=0.0,
    )
    sigma_bearing: float = parameter(
        0.006,
        "rad",
        "standard deviation of the bearing, thesis Eq. 4.9: one step of a URG-04LX (360/1024 deg), "
        "for edges that fall between beams and a beam 20 to 40 mm wide",
        gt=0.0,
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the cylinders in the order of the beams."""
        del rng
        ranges = np.where(usable(scan), scan.ranges, 0.0)
        slope = derivative(scan.angles, ranges)
        objects = candidates(slope, self.threshold)
        return [
            self._observation(scan, first, last)
            for first, last in objects
            if self._accepts(scan, ranges, first, last)
        ]

    def _accepts(self, scan: Scan, ranges: Array, first: int, last: int) -> bool:
        """Return whether the candidate has a range in its middle."""
        del scan
        return bool(np.all(ranges[_middle(first, last)] > 0.0))

    def _observation(self, scan: Scan, first: int, last: int) -> Observation:
        middle = _middle(first, last)
        opening = wrap(float(scan.directions[last] - scan.directions[first]))
        bearing = float(scan.directions[first]) + opening / 2.0
        r = float(scan.ranges[middle].mean()) + self.radius
        R_polar = np.diag([self.sigma_range**2, self.sigma_bearing**2])
        offset, R = to_cartesian(r, bearing, R_polar)
        return Observation(
            kind=self.landmark,
            z=scan.origins[middle].mean(axis=0) + offset,
            R=R,
            beams=np.arange(first, last + 1, dtype=np.int64),
            attributes={"radius": self.radius},
        )


def _middle(first: int, last: int) -> list[int]:
    """Return the two beams next to the middle, which are the same for an odd number."""
    return [(first + last) // 2, (first + last + 1) // 2]
