"""Casts rays against segments and circles, each beam from the laser's pose at its own time.

Moving objects are given at the beginning and the end of the sweep and interpolated at each beam's time.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints


@kernel
def ray_segment(ray: Array, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float]:
    """Return distance and cosine of incidence of a ray [x, y, cos, sin] on a segment.

    Solves origin + t d = start + u e by cross products; the distance is inf without an intersection.
    """
    ex, ey = x1 - x0, y1 - y0
    wx, wy = x0 - ray[0], y0 - ray[1]
    den = ray[2] * ey - ray[3] * ex
    if den == 0.0:
        return math.inf, 0.0
    t = (wx * ey - wy * ex) / den
    u = (wx * ray[3] - wy * ray[2]) / den
    if t < 0.0 or u < 0.0 or u > 1.0:
        return math.inf, 0.0
    return t, abs(den) / math.hypot(ex, ey)


@kernel
def ray_circle(ray: Array, x: float, y: float, radius: float) -> tuple[float, float]:
    """Return distance and cosine of incidence of a ray [x, y, cos, sin] on a circle.

    From inside, the far side is hit; the distance is inf without an intersection.
    """
    wx, wy = x - ray[0], y - ray[1]
    along = wx * ray[2] + wy * ray[3]
    across = wx * ray[3] - wy * ray[2]
    half2 = radius * radius - across * across
    if half2 < 0.0:
        return math.inf, 0.0
    half = math.sqrt(half2)
    t = along - half if along - half >= 0.0 else along + half
    return (t, half / radius) if t >= 0.0 else (math.inf, 0.0)


@kernel
def nearest(ray: Array, segments: Array, circles: Array, best: float) -> tuple[float, float, int]:
    """Return the nearest hit below `best` among segments (s, 4) and circles (c, 3).

    The last value is the index of the hit: 0 to s - 1 a segment, s to s + c - 1 a circle, -1 nothing.
    """
    cosine, which = 0.0, -1
    for i in range(len(segments)):
        s = segments[i]
        t, c = ray_segment(ray, s[0], s[1], s[2], s[3])
        if t < best:
            best, cosine, which = t, c, i
    for i in range(len(circles)):
        t, c = ray_circle(ray, circles[i, 0], circles[i, 1], circles[i, 2])
        if t < best:
            best, cosine, which = t, c, len(segments) + i
    return best, cosine, which


@kernel
def trace(
    lasers: Array,
    angles: Array,
    fractions: Array,
    static: tuple[Array, Array],
    moving: tuple[Array, Array],
    max_range: float,
) -> tuple[Array, Array, Ints]:
    """Return range (n,), cosine of incidence (n,) and index of the hit (n,) of n beams.

    Beyond `max_range` they are inf, 0 and -1. Indices count the static segments, the static circles, the
    moving segments and the moving circles, in this order.

    Parameters
    ----------
    lasers : (n, 3) pose of the laser in map at the time of each beam
    angles : (n,) rad, directions of the beams in the laser frame
    fractions : (n,) in [0, 1], time of each beam within the sweep
    static : segments (s, 4) [x0, y0, x1, y1] and circles (c, 3) [x, y, radius]
    moving : segments (2, m, 4) and circles (2, k, 3) at the sweep's beginning and end
    max_range : m
    """
    n = len(angles)
    ranges, cosines, hits = np.full(n, np.inf), np.zeros(n), np.full(n, -1)
    ray = np.empty(4)
    for i in range(n):
        heading = lasers[i, 2] + angles[i]
        ray[0], ray[1] = lasers[i, 0], lasers[i, 1]
        ray[2], ray[3] = math.cos(heading), math.sin(heading)
        segments = moving[0][0] + fractions[i] * (moving[0][1] - moving[0][0])
        circles = moving[1][0] + fractions[i] * (moving[1][1] - moving[1][0])
        best, cosine, hit = nearest(ray, static[0], static[1], max_range)
        found, other, mover = nearest(ray, segments, circles, best)
        if found < best:
            best, cosine, hit = found, other, len(static[0]) + len(static[1]) + mover
        if best < max_range:
            ranges[i], cosines[i], hits[i] = best, cosine, hit
    return ranges, cosines, hits
