"""Cylinders by a circle fit to whole visible arcs."""

from __future__ import annotations

import math

import numpy as np
from pydantic import model_validator

from impslam.component import parameter, register
from impslam.extractors.arcs import ArcLimits, find_arcs, neighbours
from impslam.extractors.base import Extractor
from impslam.extractors.segmentation import OBJECT_INCIDENCE, segment
from impslam.surfaces.features import beam_spacing
from impslam.types import Array, Observation, Scan


@register("circle")
class Circle(Extractor):
    """Cylinders: a circle fit to arcs in front of the background that are visible from edge to edge.

    The default for cylinders. A known `radius` makes the range of a centre 4 to 6 times better.
    Arcs that are cut by the end of the scan or occluded, that touch a wall, or that fit a line or
    a corner as well as a circle, are skipped.
    """

    landmark = "cylinder"

    radius: float | None = parameter(
        None, "m", "radius, if known and the same for all cylinders", gt=0.0
    )
    radius_min: float = parameter(
        0.03, "m", "thinnest cylinder; below, a few millimetres of noise make a circle", gt=0.0
    )
    radius_max: float = parameter(
        0.4, "m", "thickest cylinder; pillars and bins are thinner, rounded walls thicker", gt=0.0
    )
    min_points: int = parameter(
        5,
        "1",
        "minimum number of beams on a cylinder; three define a circle, two more confirm it",
        ge=4,
    )
    max_chi2: float = parameter(
        3.0, "1", "largest mean squared residual, in variances, of a round surface", gt=1.0
    )
    max_radius_sigma: float = parameter(
        0.25, "1", "largest standard deviation of the radius, as a fraction of it", gt=0.0
    )

    @model_validator(mode="after")
    def _check(self) -> Circle:
        if self.radius_min >= self.radius_max:
            raise ValueError("radius_min must be below radius_max")
        return self

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the cylinders of the scan; see `Extractor.extract`."""
        del rng
        cloud, spacing = segment(scan, OBJECT_INCIDENCE), beam_spacing(scan.angles)
        if len(cloud.index) < self.min_points:
            return []
        closed = len(scan.angles) * spacing > 2.0 * math.pi - 0.5 * spacing
        sides = neighbours(cloud.index, scan.directions, scan.ranges, scan.valid, closed)
        arcs = find_arcs(
            cloud.points,
            cloud.beams,
            cloud.variances,
            cloud.starts,
            sides,
            self._limits(spacing),
            scan.origins[cloud.index],
        )
        found = [_cylinder(row, cloud.index[int(row[0]) : int(row[1])], scan) for row in arcs]
        return sorted(found, key=lambda o: int(o.beams[0]))

    def _limits(self, spacing: float) -> ArcLimits:
        low, high = self.radius_min, self.radius_max
        if self.radius is not None:
            low, high = 0.99 * self.radius, 1.01 * self.radius
        known = math.nan if self.radius is None else self.radius
        sigma = self.max_radius_sigma
        return ArcLimits(known, low, high, self.min_points, self.max_chi2, sigma, spacing)


def _cylinder(row: Array, beams: np.ndarray, scan: Scan) -> Observation:
    """Return a row of `find_arcs` as an observation of the centre."""
    xx, xy, yy = row[5:8] * max(1.0, row[11])
    shared = scan.bias * row[8:10]
    R = np.array([[xx, xy], [xy, yy]]) + np.outer(shared, shared)
    radius = {"radius": float(row[4])}
    return Observation("cylinder", row[2:4].copy(), R, beams, None, radius, shared=shared)
