"""How the robot drives: a path follower, and the exact motion that comes of it.

Between two control steps the twist (v, omega) is constant, so that the true path is a chain of
circular arcs: pose and wheel travel are known exactly at any time, not integrated numerically.
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

CONTROL_RATE = 100.0  # Hz, that of the robot's own autopilot


class Path(Protocol):
    """Where the robot is at any time, planned or driven."""

    def at(self, times: Array) -> Array:
        """Return the poses (k, 3) in map at times (k,) s."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """True motion: n + 1 knots at `times` s with `poses` (n + 1, 3), and n twists between them.

    `twists` (n, 2) are v (m/s) and omega (rad/s). Times run from 0.
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
        way, turn = (self.twists[i] * since[:, None]).T
        x, y, heading = self.poses[i].T
        chord = way * np.sinc(turn / (2 * np.pi))
        middle = heading + 0.5 * turn
        return np.column_stack(
            [x + chord * np.cos(middle), y + chord * np.sin(middle), wrap(heading + turn)]
        )

    def travel(self, times: Array) -> tuple[Array, Array]:
        """Return way (m) and angle (rad, not wrapped) driven from the start until times (k,)."""
        steps = np.diff(self.times)[:, None] * self.twists
        driven = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        return np.interp(times, self.times, driven[:, 0]), np.interp(
            times, self.times, driven[:, 1]
        )


@functools.lru_cache(maxsize=8)  # of 3 MB for 10 min: all seeds and variants of a study drive it
def drive(plan: Drive) -> Trajectory:
    """Drive along the waypoints; the result is the same for every seed, and cannot be written to.

    Raises
    ------
    ConfigError
        If the robot does not come to the end of its way, which a short lookahead may cause.
    """
    follower = _Follower(plan)
    rest = round(plan.rest * CONTROL_RATE)
    limit = plan.limit * CONTROL_RATE
    twists = [(0.0, 0.0)] * rest
    poses = [np.array(plan.start)] * (rest + 1)
    while not follower.arrived and len(twists) < limit:
        if len(twists) > follower.patience:
            raise ConfigError(
                f"robot.waypoints: the robot gets lost near {np.round(poses[-1][:2], 2).tolist()}; "
                "give it a longer lookahead, a lower speed or a faster turn"
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

    _SPIN = 1.0  # rad: a target further off the bow is faced on the spot first
    _CLOSE = 0.01  # m: too near to the end to steer by it
    _NEAR = 1e-4  # m: the end counts as reached

    def __init__(self, plan: Drive) -> None:
        self._plan = plan
        self._way = np.vstack([plan.start[:2], plan.waypoints])
        self._steps = np.diff(self._way, axis=0)
        lengths = np.hypot(*self._steps.T)
        self._steps = self._steps / lengths[:, None]
        self._ends = np.concatenate([[0.0], np.cumsum(lengths)])
        self._done = 0.0
        self._v = self._omega = 0.0

    @property
    def patience(self) -> int:
        """Control steps after which a robot that has not arrived never will."""
        plan = self._plan
        turning = len(self._steps) * 2 * math.pi / plan.turn_rate
        driving = float(self._ends[-1]) / plan.speed
        return int((60.0 + plan.rest + 3.0 * (turning + driving)) * CONTROL_RATE)

    @property
    def arrived(self) -> bool:
        """The end is reached and the robot stands."""
        left = float(self._ends[-1]) - self._done
        return left <= self._NEAR and self._v == 0.0 and self._omega == 0.0

    def step(self, pose: Array) -> tuple[float, float]:
        """Return v and omega for the next control step from a pose (3,)."""
        self._progress(pose[:2])
        aim = min(self._done + self._plan.lookahead, float(self._ends[-1]))
        target = self._point(aim) - pose[:2]
        bearing = wrap(math.atan2(target[1], target[0]) - float(pose[2]))
        v, omega = self._wish(bearing, math.hypot(*target))
        step = 1.0 / CONTROL_RATE
        self._v = _towards(self._v, v, self._plan.acceleration * step)
        self._omega = _towards(self._omega, omega, self._plan.turn_acceleration * step)
        return self._v, self._omega

    def _wish(self, bearing: float, distance: float) -> tuple[float, float]:
        """Return the v and omega wanted for a target at a bearing and a distance."""
        plan, left = self._plan, float(self._ends[-1]) - self._done
        if left <= self._NEAR:
            return 0.0, 0.0
        if distance < self._CLOSE:
            bearing = 0.0
        if abs(bearing) > self._SPIN:
            return 0.0, math.copysign(plan.turn_rate, bearing)
        curvature = 2.0 * math.sin(bearing) / max(distance, self._CLOSE)
        v = min(plan.speed, math.sqrt(plan.acceleration * left), left * CONTROL_RATE / 4)
        v = min(v, plan.turn_rate / max(abs(curvature), 1e-9))
        return v, v * curvature

    def _progress(self, place: Array) -> None:
        """Move on to the nearest point of the way that lies at most a lookahead ahead."""
        i = self._leg(self._done)
        legs = range(i, min(i + 2, len(self._steps)))
        reachable = [
            min(self._project(place, leg), self._done + self._plan.lookahead) for leg in legs
        ]
        nearest = min(reachable, key=lambda done: math.dist(place, self._point(done)))
        self._done = max(self._done, nearest)

    def _project(self, place: Array, i: int) -> float:
        along = float((place - self._way[i]) @ self._steps[i])
        return float(np.clip(self._ends[i] + along, self._ends[i], self._ends[i + 1]))

    def _leg(self, distance: float) -> int:
        i = int(np.searchsorted(self._ends, distance, side="right")) - 1
        return min(max(i, 0), len(self._steps) - 1)

    def _point(self, distance: float) -> Array:
        """Return the point (2,) at a distance along the way."""
        i = self._leg(distance)
        return np.asarray(self._way[i] + (distance - self._ends[i]) * self._steps[i])


def _towards(value: float, wish: float, step: float) -> float:
    return value + min(max(wish - value, -step), step)
