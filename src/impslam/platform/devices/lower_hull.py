"""The lower convex hull of the arrivals of a device's readings, for lines that lie below all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TypeAlias

Point: TypeAlias = tuple[float, float]


def edge_at_mean(points: Sequence[Point]) -> tuple[Point, Point] | None:
    """Return the edge of the lower hull at the mean x of points sorted by x.

    Of all lines below the points, the one through this edge is the highest at their mean, and so the
    closest to them (Zhang, Liu and Xia, INFOCOM 2002). None if all points have the same x.
    """
    mean = sum(x for x, _ in points) / len(points)
    edges = pairwise(lower_hull(points))
    return next(((a, b) for a, b in edges if b[0] >= mean and b[0] > a[0]), None)


def lower_hull(points: Iterable[Point]) -> list[Point]:
    """Return the lower convex hull of points sorted by x (Andrew's monotone chain)."""
    hull: list[Point] = []
    for point in points:
        while len(hull) > 1 and _is_not_convex(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _is_not_convex(a: Point, b: Point, c: Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
