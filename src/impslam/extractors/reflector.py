"""Retro-reflective beacons, by the brightness of their echoes.

A lidar that measures the brightness of echoes sees a reflector as one or a few beams that are far brighter
than all others: its shape need not be known, and nothing else looks like it, so that it is the most
reliable landmark. Its position within the beams is unknown, so that the spacing of the beams limits the
accuracy of its direction (Guivant et al. 2000, sec. 3).
"""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.readings import in_beam_order, usable
from impslam.geometry.angles import wrap
from impslam.geometry.polar import to_cartesian
from impslam.surfaces.features import beam_spacing
from impslam.types import Array, Ints, Observation, Scan


@register("reflector")
class Reflector(Extractor):
    """Beacons: neighbouring beams of bright echoes, as points."""

    landmark = "point"

    threshold: float = parameter(
        1.0, "device", "smallest brightness of a reflector's echo, in the lidar's unit", gt=0.0
    )
    max_gap: float = parameter(
        0.5, "m", "bright echoes farther apart than this belong to two reflectors", gt=0.0
    )
    max_size: float = parameter(
        1.0,
        "m",
        "widest beacon; signs, number plates and glossy walls are wider",
        gt=0.0,
    )
    min_beams: int = parameter(
        1, "1", "minimum number of bright beams; from 10 m on one beam or none hits a post", ge=1
    )
    radius: float = parameter(
        0.0, "m", "radius of the post: distance of its axis behind the surface", ge=0.0
    )
    sigma_surface: float = parameter(
        0.02, "m", "standard deviation of the hit point from the middle of the reflector", ge=0.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the reflectors of the scan; see `Extractor.extract`."""
        del rng
        if scan.intensities is None:
            return []
        with np.errstate(invalid="ignore"):
            bright = np.flatnonzero(usable(scan) & (scan.intensities >= self.threshold))
        if len(bright) == 0:
            return []
        spacing = beam_spacing(scan.angles)
        found = [
            self._beacon(scan, beams, spacing)
            for beams in self._groups(scan, bright)
            if self._fits(scan, beams)
        ]
        return in_beam_order(found)

    def _groups(self, scan: Scan, bright: Ints) -> list[Ints]:
        """Return the bright beams of each reflector; that of a full turn may lie across its ends."""
        points = scan.points[bright]
        steps = np.hypot(*(points - np.roll(points, 1, axis=0)).T)
        begins = np.flatnonzero(steps > self.max_gap)
        if len(begins) == 0:
            return [bright]
        return np.split(np.roll(bright, -begins[0]), begins[1:] - begins[0])

    def _fits(self, scan: Scan, beams: Ints) -> bool:
        width = np.ptp(scan.points[beams], axis=0)
        return len(beams) >= self.min_beams and math.hypot(*width) <= self.max_size

    def _beacon(self, scan: Scan, beams: Ints, spacing: float) -> Observation:
        """Return the middle of the beams, with covariance from noise and the spacing of beams."""
        n, first = len(beams), float(scan.directions[beams[0]])
        direction = first + float(np.mean(wrap(scan.directions[beams] - first)))
        distance = float(scan.ranges[beams].mean())
        range_variance = (
            float(np.mean(scan.sigmas[beams] ** 2)) / n + scan.bias**2 + self.sigma_surface**2
        )
        # The direction from one beam is uniform within a spacing; more beams are slightly better.
        bearing_variance = (
            spacing**2 / 12.0 + (self.sigma_surface / max(distance, self.sigma_surface)) ** 2
        )
        point, R = to_cartesian(
            distance + self.radius, direction, np.diag([range_variance, bearing_variance])
        )
        origin: Array = scan.origins[beams].mean(axis=0)
        return Observation("point", origin + point, R + 1e-12 * np.eye(2), beams)
