"""Walls by random sample consensus (thesis Algorithm 1), including spurious ones."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.readings import in_beam_order, usable, wall_observation
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.geometry.lines import principal_direction
from impslam.types import Array, Ints, Observation, Scan


@kernel
def _sample(near: Ints, size: int, random: Array) -> None:
    """Bring `random.size` entries, drawn without replacement, to the front of near[:size]."""
    for k in range(len(random)):
        j = k + int(random[k] * (size - k))
        near[k], near[j] = near[j], near[k]


@kernel
def associate(
    points: Array, angles: Array, random: Array, within: float, distance: float, consensus: int
) -> Ints:
    """Run the loop of Algorithm 1 and return (n,) the line each reading belongs to, -1 for none.

    Parameters
    ----------
    points, angles : (n, 2) m and (n,) rad
    random : (N, S + 1) uniform in [0, 1): of each trial, the first reading and its S samples
    within, distance, consensus : D in rad, X in m, C
    """
    line_of = np.full(len(points), -1)
    samples = random.shape[1] - 1
    ones = np.ones(len(points))
    lines = 0
    for trial in range(len(random)):
        unassigned = np.flatnonzero(line_of < 0)
        if len(unassigned) <= consensus:
            break
        seed = unassigned[int(random[trial, 0] * len(unassigned))]
        separation = np.abs(wrap_in_kernel(angles[unassigned] - angles[seed]))
        near = unassigned[(separation <= within) & (unassigned != seed)]
        if len(near) < samples:
            continue
        _sample(near, len(near), random[trial, 1:])
        chosen = np.append(near[:samples], seed)
        x, y, alpha = principal_direction(points[chosen], ones[: samples + 1])
        distances = (points[unassigned, 0] - x) * math.cos(alpha) + (
            points[unassigned, 1] - y
        ) * math.sin(alpha)
        close = unassigned[np.abs(distances) <= distance]
        if len(close) > consensus:
            line_of[close] = lines
            lines += 1
    return line_of


@register("ransac")
class Ransac(Extractor):
    """Walls by random sample consensus (thesis 4.2.2, Algorithm 1).

    The loop is as printed: while more readings than C are unassociated and fewer than N trials are
    done, a random reading and S random ones within D degrees of it give a least-squares line; if
    more than C unassociated readings lie within X of it, a new line is fitted to them, and they are
    removed. A trial with fewer than S readings within D counts, too. Fits are orthogonal least
    squares, with equal weights.

    A reading off the walls, or one near a corner, can give a line across the room that still has more than
    C readings: spurious walls, which made the thesis prefer `hough` (4.2.3). Lines are infinite:
    collinear walls are one, and the end points are the outermost readings.
    """

    landmark: ClassVar[str] = "wall"

    trials: int = parameter(
        100,
        "1",
        "N, maximum number of attempts in a scan: with 6 walls, the last of them a tenth of the "
        "readings, all are tried with a probability above 99.9 %",
        ge=1,
    )
    samples: int = parameter(
        8,
        "1",
        "S, readings sampled beside the first one for a line: with noise of 20 mm over 0.7 m "
        "they give its direction to 2 deg",
        ge=1,
    )
    degrees: float = parameter(
        10.0,
        "deg",
        "D, angle from the first reading within which to sample: 57 beams of a URG-04LX, 0.7 m of a wall "
        "2 m away, less than most walls",
        gt=0.0,
        le=180.0,
    )
    distance: float = parameter(
        0.05,
        "m",
        "X, largest distance of a reading from its line: 2.5 standard deviations of a "
        "URG-04LX at 2 m (1 %)",
        gt=0.0,
    )
    consensus: int = parameter(
        50,
        "1",
        "C, number of readings that a wall must exceed: one metre of wall 3 m away from a URG-04LX",
        ge=2,
    )
    sigma_rho: float = parameter(
        0.02,
        "m",
        "standard deviation of rho, thesis Eq. 4.9: the error common to a URG-04LX's readings at "
        "2 m (1 %), which does not average out",
        gt=0.0,
    )
    sigma_alpha: float = parameter(
        0.02,
        "rad",
        "standard deviation of alpha, thesis Eq. 4.9: that shared error from one end to the other "
        "of a metre of wall",
        gt=0.0,
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the walls in the order of the beams; the same rng state gives the same walls."""
        random = rng.random((self.trials, self.samples + 1))
        beams = np.flatnonzero(usable(scan))
        line_of = associate(
            scan.points[beams],
            scan.angles[beams],
            random,
            math.radians(self.degrees),
            self.distance,
            self.consensus,
        )
        lines = range(line_of.max(initial=-1) + 1)
        return in_beam_order([self._wall(scan, beams[line_of == line]) for line in lines])

    def _wall(self, scan: Scan, beams: Ints) -> Observation:
        x, y, alpha = principal_direction(scan.points[beams], np.ones(len(beams)))
        rho = x * math.cos(alpha) + y * math.sin(alpha)
        return wall_observation(scan, rho, alpha, beams, (self.sigma_rho, self.sigma_alpha))
