"""Simulates the legs of walking people."""

from __future__ import annotations

import math
from bisect import bisect_left
from itertools import accumulate, pairwise

from impslam.simulation.world import Person

Leg = tuple[float, float, float]


class PersonWalk:
    """The walk of a person; it uses plain floats for speed, as it is called twice per sweep."""

    def __init__(self, person: Person) -> None:
        self._person = person
        points = person.waypoints
        lengths = [math.dist(a, b) for a, b in pairwise(points)]
        self._ends = list(accumulate(lengths))
        self._along = [
            ((b[0] - a[0]) / length, (b[1] - a[1]) / length)
            for (a, b), length in zip(pairwise(points), lengths, strict=True)
        ]

    def legs(self, time: float) -> list[Leg]:
        """Return both legs [x, y, radius] at a time, left leg first."""
        person, length = self._person, self._ends[-1]
        walked = person.speed * max(time - person.start, 0.0)
        lap = int(walked // length) if person.returns else 0
        done = min(walked - lap * length, length)
        back = lap % 2 == 1
        feet = self._foot(done, 0.0), self._foot(done, math.pi)
        half = -0.5 * person.leg_spacing if back else 0.5 * person.leg_spacing
        return [
            self._place(length - foot if back else foot, side)
            for foot, side in zip(feet, (half, -half), strict=True)
        ]

    def _foot(self, done: float, phase: float) -> float:
        """Return the distance of a foot along the path, given that of the body.

        A foot is at s + stride / 2 pi sin(2 pi s / stride): at rest once per stride and up to twice as
        fast as the body in between; the other foot is half a stride behind. Both are side by side at the
        ends of the path.
        """
        stride = self._person.stride
        fade = min(1.0, done / stride, (self._ends[-1] - done) / stride)
        return done + fade * stride / (2 * math.pi) * math.sin(2 * math.pi * done / stride + phase)

    def _place(self, distance: float, left: float) -> Leg:
        """Return the leg at a distance along the path and an offset to its left."""
        i = min(bisect_left(self._ends, distance), len(self._ends) - 1)
        (end_x, end_y), (dx, dy) = self._person.waypoints[i + 1], self._along[i]
        missing = self._ends[i] - distance
        x, y = end_x - missing * dx - left * dy, end_y - missing * dy + left * dx
        return x, y, self._person.leg_radius
