"""Cylinders as jumps of the range, filtered by the expected shape (thesis 4.1.2)."""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.jump import Jump
from impslam.extractors.readings import rms_off_line
from impslam.geometry.angles import wrap
from impslam.types import Array, Scan


@register("filtered_jump")
class FilteredJump(Jump):
    """Cylinders from small jumps, filtered by count, width and curvature (thesis 4.1.2, 5.2.1).

    A low threshold gives many candidates. A candidate is kept if it has enough readings, if its angular
    width is that of a cylinder of the known radius at its distance (2 asin(radius / d) with d to the
    axis), and if it is not straight. For the last test, the thesis gives 9 % without a reference quantity.
    Here it is the root mean square distance of the points from their least-squares line, relative to the
    chord from the first to the last: 11.2 % for a cylinder seen from afar (sqrt(2/3 - pi^2/16) / 2), 0 for
    a wall, so 9 % separates them. A candidate that has lost a tenth of the radius at each side is below
    it, and so is one whose axis is nearer than 0.8 m, since less of its curve is visible (8.5 % at 0.6 m,
    5.9 % at 0.3 m): the filter is conservative, like that of the thesis (5.2.1).

    Beams without return count as range 0, as for `jump`.
    """

    threshold: float = parameter(
        15.0,
        "m/rad",
        "jump of the range per angle that bounds a candidate: 0.09 m between two beams of a "
        "URG-04LX, low as in the thesis, above the steps over a cylinder's own curve at 4 m",
        gt=0.0,
    )
    min_points: int = parameter(
        11, "1", "minimum number of readings on a candidate (thesis 5.2.1)", ge=2
    )
    narrowest: float = parameter(
        0.7,
        "1",
        "smallest angular width of a candidate relative to the predicted one: of 11 readings, the "
        "minimum, up to two at each edge are lost to the curve and to mixed ranges",
        ge=0.0,
        le=1.0,
    )
    widest: float = parameter(
        1.3,
        "1",
        "largest angular width relative to the predicted one: a beam's own width and mixed ranges "
        "add up to two readings of 11 at each edge, hardly ever all",
        ge=1.0,
    )
    curvature: float = parameter(
        0.09,
        "1",
        "smallest root mean square distance from the least-squares line, relative to the chord "
        "(thesis 5.2.1: 9 %); 0.112 for a cylinder, 0 for a wall",
        ge=0.0,
    )

    def _accepts(self, scan: Scan, ranges: Array, first: int, last: int) -> bool:
        if not super()._accepts(scan, ranges, first, last):
            return False
        beams = first + np.flatnonzero(ranges[first : last + 1] > 0.0)
        return bool(
            len(beams) >= self.min_points
            and self._width_fits(scan, first, last)
            and self._is_curved(scan.points[beams])
        )

    def _width_fits(self, scan: Scan, first: int, last: int) -> bool:
        # Each reading covers one step, so n of them are n steps wide, not n - 1.
        between = abs(wrap(float(scan.angles[last] - scan.angles[first])))
        width = between * (last - first + 1) / (last - first)
        r = float(scan.ranges[(first + last) // 2])
        predicted = 2.0 * math.asin(self.radius / (r + self.radius))
        return self.narrowest * predicted <= width <= self.widest * predicted

    def _is_curved(self, points: Array) -> bool:
        chord = math.dist(points[0], points[-1])
        return chord > 0.0 and rms_off_line(points) >= self.curvature * chord
