"""Shared by the thesis's extractors: usable readings, and a wall as an observation."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap
from impslam.types import Array, Ints, Mask, Observation, Scan


def usable(scan: Scan) -> Mask:
    """Return which beams (n,) are valid and have a finite range and point."""
    return scan.valid & np.isfinite(scan.ranges) & np.isfinite(scan.points).all(axis=1)


def wall_observation(
    scan: Scan, rho: float, alpha: float, beams: Ints, sigmas: tuple[float, float]
) -> Observation:
    """Return the wall {p : p . n(alpha) = rho}, of either sign, seen by these beams.

    The normal is turned to point away from the laser. The end points are the outermost of the
    beams' points, projected on the line, in the order of the beams.
    R is thesis Eq. 4.9 with the diagonal squared (it prints standard deviations): `sigmas` are
    those of rho (m) and alpha (rad).
    """
    laser = scan.laser[:2]
    if laser[0] * math.cos(alpha) + laser[1] * math.sin(alpha) > rho:
        rho, alpha = -rho, alpha + math.pi
    normal = np.array([math.cos(alpha), math.sin(alpha)])
    tangent = np.array([-normal[1], normal[0]])
    positions = scan.points[beams] @ tangent
    ends = np.array([positions.min(), positions.max()])
    if positions[0] > positions[-1]:
        ends = ends[::-1]
    return Observation(
        kind="wall",
        z=np.array([rho, wrap(alpha)]),
        R=np.diag(np.square(np.array(sigmas))),
        beams=beams,
        end_points=rho * normal + ends[:, None] * tangent,
    )


def in_beam_order(observations: list[Observation]) -> list[Observation]:
    """Return the observations sorted by their first beam."""
    return sorted(observations, key=lambda observation: int(observation.beams[0]))


def rms_off_line(points: Array) -> float:
    """Return the root mean square distance of points (n, 2) from their least-squares line, m."""
    centred = points - points.mean(axis=0)
    smallest = float(np.linalg.eigvalsh(centred.T @ centred / len(points))[0])
    return math.sqrt(max(smallest, 0.0))
