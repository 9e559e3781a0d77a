"""Drives the robot with a path follower and provides its exact motion.

Between two control steps the twist (v, omega) is constant, so that the true path consists of circular
arcs: pose and wheel travel are known exactly at any time, without numerical integration.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from impslam.errors import ConfigError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, exp
from impslam.simulation.world import Drive
from impslam.types import Array

CONTROL_RATE = 100.0  # Hz, as in the robot's autopilot


class Path(Protocol):
    """The robot's pose at any time, planned or driven."""

    def at(self, times: Array) -> Array:
        """Return the poses (k, 3) in map at times (k,) s."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """True motion: n + 1 knots at `times` s with `poses` (n + 1, 3), and n twists between them.

    `twists` (n, 2) are v (m/s) and omega (rad/s). Times start at 0.
    """

    times: Array
    poses: Array
    twists: Array

    @property
    def duration(self) -> float:
        """Time from first to last knot, in s."""
        return float(self.times[-1])

    def at(self, times: Array) -> Array:
        """Return the exact poses (k, 3) at times (k,) s within the run."""
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.twists) - 1)
        since = times - self.times[i]
        distance, turn = (self.twists[i] * since[:, None]).T
        x, y, heading = self.poses[i].T
        chord = distance * np.sinc(turn / (2 * np.pi))
        middle = heading + 0.5 * turn
        return np.column_stack(
            [x + chord * np.cos(middle), y + chord * np.sin(middle), wrap(heading + turn)]
        )

    def travel(self, times: Array) -> tuple[Array, Array]:
        """Return distance (m) and angle (rad, not wrapped) driven from the start until times (k,)."""
        steps = np.diff(self.times)[:, None] * self.twists
        driven = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        return np.interp(times, self.times, driven[:, 0]), np.interp(
            times, self.times, driven[:, 1]
        )


@functools.lru_cache(maxsize=8)  # 3 MB for 10 min; shared by all seeds and variants of a study
def drive(plan: Drive) -> Trajectory:
    """Drive along the waypoints; the result does not depend on a seed and is read-only.

    Raises
    ------
    ConfigError
        If the robot does not reach the end of its path, e.g. because of a short lookahead.
    """
    follower = _Follower(plan)
    rest = round(plan.rest * CONTROL_RATE)
    limit = plan.limit * CONTROL_RATE
    twists = [(0.0, 0.0)] * rest
    poses = [np.array(plan.start)] * (rest + 1)
    while not follower.arrived and len(twists) < limit:
        if len(twists) > follower.max_steps:
            raise ConfigError(
                f"robot.waypoints: the robot gets lost near {np.round(poses[-1][:2], 2).tolist()}; "
                "increase lookahead or turn_rate, or reduce speed"
            )
        twist = follower.step(poses[-1])
        poses.append(advance(poses[-1], twist, 1.0 / CONTROL_RATE))
        twists.append(twist)
    twists += [(0.0, 0.0)] * rest
    poses += [poses[-1]] * rest
    n = min(len(twists), int(min(limit, len(twists))))
    times = np.arange(n + 1) / CONTROL_RATE
    driven = Trajectory(times, np.array(poses[: n + 1]), np.array(twists[:n]))
    for array in (driven.times, driven.poses, driven.twists):
        array.setflags(write=False)
    return driven


def advance(pose: Array, twist: tuple[float, float], duration: float) -> Array:
    """Return the pose (3,) after an exact arc at constant v (m/s) and omega (rad/s)."""
    return compose(pose, exp(np.array([twist[0] * duration, 0.0, twist[1] * duration])))


class _Follower:
    """Pure pursuit (Coulter 1992) with limits on speed, turn rate and their changes."""

    _MAX_BEARING = 1.0
    """rad; with a larger bearing of the target, the robot first turns on the spot."""
    _MIN_DISTANCE = 0.01  # m; below it, the target does not determine the steering
    _ARRIVAL_DISTANCE = 1e-4  # m; within it, the end counts as reached

    def __init__(self, plan: Drive) -> None:
        self._plan = plan
        self._points = np.vstack([plan.start[:2], plan.waypoints])
        self._steps = np.diff(self._points, axis=0)
        lengths = np.hypot(*self._steps.T)
        self._steps = self._steps / lengths[:, None]
        self._ends = np.concatenate([[0.0], np.cumsum(lengths)])
        self._done = 0.0
        self._v = self._omega = 0.0

    @property
    def max_steps(self) -> int:
        """Number of control steps after which a robot that has not arrived never will."""
        plan = self._plan
        turning = len(self._steps) * 2 * math.pi / plan.turn_rate
        driving = float(self._ends[-1]) / plan.speed
        return int((60.0 + plan.rest + 3.0 * (turning + driving)) * CONTROL_RATE)

    @property
    def arrived(self) -> bool:
        """Whether the robot has stopped at the end."""
        remaining = float(self._ends[-1]) - self._done
        return remaining <= self._ARRIVAL_DISTANCE and self._v == 0.0 and self._omega == 0.0

    def step(self, pose: Array) -> tuple[float, float]:
        """Return v and omega for the next control step from a pose (3,)."""
        self._advance(pose[:2])
        aim = min(self._done + self._plan.lookahead, float(self._ends[-1]))
        target = self._point(aim) - pose[:2]
        bearing = wrap(math.atan2(target[1], target[0]) - float(pose[2]))
        v, omega = self._desired_twist(bearing, math.hypot(*target))
        step = 1.0 / CONTROL_RATE
        self._v = _approach(self._v, v, self._plan.acceleration * step)
        self._omega = _approach(self._omega, omega, self._plan.turn_acceleration * step)
        return self._v, self._omega

    def _desired_twist(self, bearing: float, distance: float) -> tuple[float, float]:
        """Return the desired v and omega for a target at a bearing and a distance."""
        plan, remaining = self._plan, float(self._ends[-1]) - self._done
        if remaining <= self._ARRIVAL_DISTANCE:
            return 0.0, 0.0
        if distance < self._MIN_DISTANCE:
            bearing = 0.0
        if abs(bearing) > self._MAX_BEARING:
            return 0.0, math.copysign(plan.turn_rate, bearing)
        curvature = 2.0 * math.sin(bearing) / max(distance, self._MIN_DISTANCE)
        v = min(plan.speed, math.sqrt(plan.acceleration * remaining), remaining * CONTROL_RATE / 4)
        v = min(v, plan.turn_rate / max(abs(curvature), 1e-9))
        return v, v * curvature

    def _advance(self, position: Array) -> None:
        """Advance to the nearest point of the path that is at most a lookahead ahead."""
        i = self._leg(self._done)
        legs = range(i, min(i + 2, len(self._steps)))
        reachable = [
            min(self._project(position, leg), self._done + self._plan.lookahead) for leg in legs
        ]
        nearest = min(reachable, key=lambda done: math.dist(position, self._point(done)))
        self._done = max(self._done, nearest)

    def _project(self, position: Array, i: int) -> float:
        along = float((position - self._points[i]) @ self._steps[i])
        return float(np.clip(self._ends[i] + along, self._ends[i], self._ends[i + 1]))

    def _leg(self, distance: float) -> int:
        i = int(np.searchsorted(self._ends, distance, side="right")) - 1
        return min(max(i, 0), len(self._steps) - 1)

    def _point(self, distance: float) -> Array:
        """Return the point (2,) at a distance along the path."""
        i = self._leg(distance)
        return np.asarray(self._points[i] + (distance - self._ends[i]) * self._steps[i])


def _approach(value: float, target: float, max_step: float) -> float:
    return value + min(max(target - value, -max_step), max_step)
