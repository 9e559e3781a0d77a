"""Exact scans of straight walls and circles, with the truth in base_link, for extractors' tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.geometry.se2 import between, compose, inverse, transform
from impslam.types import Array, Ints, Scan

URG_ANGLES = np.linspace(-2.0862, 2.0924, 682)  # rad, Hokuyo URG-04LX, steps 44 to 725
ORIGIN = np.zeros(3)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan and what it truly shows, in base_link.

    `walls` (w, 2) are [rho, alpha], normal into the wall as the laser sees it; `ends` (w, 2, 2) the
    walls' own ends; `circles` (c, 3) are x, y, radius. `hit` (n,) is what each beam met: 0..w-1 a
    wall, w..w+c-1 a circle, -1 nothing in range.
    """

    scan: Scan
    walls: Array
    ends: Array
    circles: Array
    hit: Ints

    def beams_on_wall(self, wall: int) -> Ints:
        return np.flatnonzero(self.hit == wall)

    def beams_on_circle(self, circle: int) -> Ints:
        return np.flatnonzero(self.hit == len(self.walls) + circle)


def room(left: float, right: float, bottom: float, top: float) -> Array:
    """Return the four walls (4, 2, 2) of a rectangle: right, top, left, bottom."""
    corners = np.array([[right, bottom], [right, top], [left, top], [left, bottom]])
    return np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)


def regular_angles(beams: int, fov: float) -> Array:
    """Return beam angles centred on the laser's x axis; a full turn leaves out the last beam."""
    full = np.isclose(fov, 2.0 * np.pi)
    return np.linspace(-fov / 2.0, fov / 2.0, beams, endpoint=not full)


def _to_walls(origin: Array, directions: Array, walls: Array) -> Array:
    """Return (n, w) distances along the beams to the walls, inf for a miss."""
    u = np.column_stack((np.cos(directions), np.sin(directions)))[:, None]
    start, along = walls[:, 0] - origin, walls[:, 1] - walls[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        det = u[..., 0] * along[:, 1] - u[..., 1] * along[:, 0]
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / det
        s = (start[:, 0] * u[..., 1] - start[:, 1] * u[..., 0]) / det
        return np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf)


def _to_circles(origin: Array, directions: Array, circles: Array) -> Array:
    """Return (n, c) distances along the beams to the circles, inf for a miss."""
    u = np.column_stack((np.cos(directions), np.sin(directions)))[:, None]
    to_centre = circles[:, :2] - origin
    along = np.sum(u * to_centre, axis=2)
    off2 = np.sum(to_centre**2, axis=1) - along**2
    half2 = circles[:, 2] ** 2 - off2
    t = along - np.sqrt(np.maximum(half2, 0.0))
    return np.where((half2 >= 0.0) & (t > 0.0), t, np.inf)


def _walls_in_base(walls: Array, laser: Array) -> Array:
    """Return (w, 2) [rho, alpha], the normal pointing away from the laser."""
    along = walls[:, 1] - walls[:, 0]
    normal = np.column_stack((along[:, 1], -along[:, 0])) / np.hypot(*along.T)[:, None]
    rho = np.sum(normal * walls[:, 0], axis=1)
    sign = np.where(rho >= normal @ laser[:2], 1.0, -1.0)
    return np.column_stack((sign * rho, np.arctan2(sign * normal[:, 1], sign * normal[:, 0])))


def cast(
    walls: Array,
    circles: Array | None = None,
    *,
    pose: Array = ORIGIN,
    laser: Array = ORIGIN,
    angles: Array = URG_ANGLES,
    upside_down: bool = False,
    noise: float = 0.0,
    sigma: float = 0.01,
    bias: float = 0.0,
    range_max: float = 5.6,
    rng: np.random.Generator | None = None,
) -> Scene:
    """Return what a robot at `pose` in map scans of walls (w, 2, 2) and circles (c, 3) in map.

    `noise` is what is added to the ranges, `sigma` what the scan says about it: m, both.
    """
    circles = np.empty((0, 3)) if circles is None else np.asarray(circles, float).reshape(-1, 3)
    in_laser = -angles if upside_down else angles
    T_map_laser = compose(pose, laser)
    in_map = T_map_laser[2] + in_laser
    origin = T_map_laser[:2]
    t = np.hstack((_to_walls(origin, in_map, walls), _to_circles(origin, in_map, circles)))
    nearest = np.argmin(t, axis=1)
    ranges = t[np.arange(len(t)), nearest]
    if noise > 0.0:
        ranges = ranges + noise * (rng or np.random.default_rng(0)).standard_normal(len(ranges))
    valid = (ranges > 0.02) & (ranges <= range_max)
    ranges = np.where(valid, ranges, 0.0)
    directions = laser[2] + in_laser
    scan = Scan(
        stamp=0.0,
        angles=angles,
        ranges=ranges,
        valid=valid,
        points=laser[:2]
        + ranges[:, None] * np.column_stack((np.cos(directions), np.sin(directions))),
        directions=directions,
        origins=np.tile(laser[:2], (len(angles), 1)),
        sigmas=np.full(len(angles), sigma),
        bias=bias,
        range_max=range_max,
        laser=laser,
    )
    T_base_map = inverse(pose)
    ends = transform(T_base_map, walls)
    centres = np.column_stack((transform(T_base_map, circles[:, :2]), circles[:, 2]))
    hit = np.where(valid, nearest, -1)
    return Scene(scan, _walls_in_base(ends, laser), ends, centres, hit)


def with_ranges(scan: Scan, ranges: Array, valid: np.ndarray | None = None) -> Scan:
    """Return the scan with other ranges; valid (unless given) where finite, positive, in range."""
    if valid is None:
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(ranges) & (ranges > 0.0) & (ranges <= scan.range_max)
    with np.errstate(invalid="ignore"):
        points = scan.origins + ranges[:, None] * np.column_stack(
            (np.cos(scan.directions), np.sin(scan.directions))
        )
    return Scan(
        scan.stamp,
        scan.angles,
        ranges,
        valid,
        points,
        scan.directions,
        scan.origins,
        scan.sigmas,
        scan.bias,
        scan.range_max,
        scan.laser,
    )


def people(
    rng: np.random.Generator, count: int, nearest: float = 0.8, farthest: float = 2.5
) -> Array:
    """Return circles (count, 3) about the size of legs and bodies, at random places round 0."""
    distance = rng.uniform(nearest, farthest, count)
    bearing = rng.uniform(-np.pi, np.pi, count)
    radius = rng.uniform(0.06, 0.2, count)
    return np.column_stack((distance * np.cos(bearing), distance * np.sin(bearing), radius))


def seen_from(pose: Array, point: Array) -> Array:
    """Return a point in map (2,) as it lies in base_link of a robot at `pose`."""
    return between(pose, np.array([*point, 0.0]))[:2]
