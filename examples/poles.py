"""An extractor in one file: thin things that stand free, by their nearest point.

Use it with `plugins = ["poles.py"]` and `sensors.lidar.extractors.cylinders.kind = "poles"`, which replaces
the extractor of cylinders. It needs no landmark model of its own: it finds what the shipped kind "cylinder"
describes.
"""

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.types import Observation, Scan


@register("poles")
class Poles(Extractor):
    """Groups of neighbouring beams with nothing near on either side."""

    landmark = "cylinder"

    radius: float = parameter(0.1524, "m", "radius of the poles", gt=0.0)
    gap: float = parameter(0.15, "m", "how far behind a pole its surroundings begin", gt=0.0)
    min_points: int = parameter(5, "1", "fewest beams on a pole", ge=3)

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the poles in the order of the beams."""
        beams = np.flatnonzero(scan.valid)
        if len(beams) == 0:
            return []
        jumps = np.diff(scan.ranges[beams])
        groups = np.split(beams, np.flatnonzero(np.abs(jumps) > self.gap) + 1)
        return [self._observe(scan, g) for g in groups[1:-1] if self._stands_free(scan, g)]

    def _stands_free(self, scan: Scan, group: np.ndarray) -> bool:
        """Tell whether all beside it is farther away, and the group as wide as the pole."""
        first, last = int(group[0]), int(group[-1])
        if first < 2 or last + 2 >= len(scan.ranges):
            return False
        behind = min(scan.ranges[first - 2], scan.ranges[last + 2])  # the next one may hit the edge
        width = float(np.linalg.norm(scan.points[last] - scan.points[first]))
        return bool(
            len(group) >= self.min_points
            and behind > scan.ranges[group].max() + self.gap
            and self.radius < width < 2.2 * self.radius
        )

    def _observe(self, scan: Scan, group: np.ndarray) -> Observation:
        """Return the axis: behind the nearest points, in the middle of the group."""
        bearing = 0.5 * (scan.directions[group[0]] + scan.directions[group[-1]])
        middle = group[len(group) // 4 : -(len(group) // 4) or None]
        # On the middle half of the face a cylinder lies 4.3 % of its radius behind its front.
        front = float(np.mean(scan.ranges[middle])) - 0.043 * self.radius
        ray = np.array([np.cos(bearing), np.sin(bearing)])
        across = np.array([-ray[1], ray[0]])
        along_sigma = np.hypot(scan.sigmas[middle].mean(), 0.05 * self.radius)
        edge_sigma = scan.ranges[middle].mean() * abs(scan.angles[1] - scan.angles[0])
        R = along_sigma**2 * np.outer(ray, ray) + edge_sigma**2 * np.outer(across, across)
        z = scan.origins[middle].mean(axis=0) + (front + self.radius) * ray
        return Observation("cylinder", z, R, group, attributes={"radius": self.radius})
