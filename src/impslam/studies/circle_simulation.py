"""Monte Carlo simulation for the comparison of filters: a circle among landmarks, with noise.

It reproduces Huang, Mourikis & Roumeliotis 2010 ("Observability-based rules for designing consistent EKF
SLAM estimators", simulations) in the size used by public comparisons of invariant filters: a robot drives
several rounds of a circle of radius v/omega and measures, with noise, its speed and turn rate and the
positions of landmarks in range in its own frame. Data association is known.

The robot moves one step before its first measurement. The heading error of that step rotates the whole map
and cannot be corrected by later measurements; a filter that becomes more certain of it is overconfident.
It also causes most of the position error, so filters differ little in their mean position error.

`LONG_LOOP` is the same robot on a longer circle: it measures only nearby landmarks, and observes those of
the start again only when it returns, with an uncorrected error of metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from impslam.geometry.se2 import compose, inverse, transform
from impslam.types import Array, Mask

START_SIGMA = 1e-4
"""m and rad: the start defines the map's origin."""


@dataclass(frozen=True, slots=True)
class Setting:
    """The robot, its noise, and the ring of landmarks around its circle.

    `wheel_sigma` is the noise of the speed of each wheel. It causes noise of the robot's speed,
    `wheel_sigma / sqrt(2)`, and of its turn rate, `sqrt(2) wheel_sigma / wheelbase`.
    """

    speed: float = 0.25  # m/s
    turn_rate: float = 0.075  # rad/s
    dt: float = 1.0  # s
    steps: int = 400  # poses, the start included
    wheel_sigma: float = 0.02  # m/s
    wheelbase: float = 0.5  # m
    landmarks: int = 15
    clearance: float = 2.5  # m, from the robot's circle out to the ring of landmarks
    sigma: float = 0.1  # m, of a landmark's position, each axis
    min_range: float = 0.5  # m
    max_range: float = 5.0  # m

    @property
    def motion_sigmas(self) -> Array:
        """(3,) standard deviations of an increment: along (m), across (m), turn (rad)."""
        speed = self.wheel_sigma / math.sqrt(2.0)
        turn_rate = math.sqrt(2.0) * self.wheel_sigma / self.wheelbase
        return self.dt * np.array([speed, 0.0, turn_rate])

    def path(self) -> Array:
        """Return the true poses (steps, 3); each step is a straight motion followed by a turn."""
        d = self.dt * np.array([self.speed, 0.0, self.turn_rate])
        poses = np.zeros((self.steps, 3))
        for k in range(1, self.steps):
            poses[k] = compose(poses[k - 1], d)
        return poses

    def ring(self) -> Array:
        """Return the landmarks (landmarks, 2), evenly spaced around the circle's centre."""
        radius = self.speed / self.turn_rate
        angles = 2.0 * np.pi * np.arange(1, self.landmarks + 1) / self.landmarks
        ring = (radius + self.clearance) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return np.asarray(ring + np.array([0.0, radius]), dtype=np.float64)


HUANG = Setting()
"""Circles of 21 m, 4.7 of them; most landmarks are in sight most of the time."""
LONG_LOOP = Setting(speed=0.5, turn_rate=0.025, steps=520, landmarks=60)
"""A circle of 126 m, twice round; 4 of 60 landmarks in sight at a time, each for a dozen metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """The data of one run.

    Attributes
    ----------
    truth : (steps, 3) true poses
    odometry : (steps - 1, 3) measured motion of each step, in the robot's frame
    measurements : (steps - 1, n, 2) m, positions of n landmarks in the robot's frame after each step
    in_range : (steps - 1, n), whether they are measured
    """

    truth: Array
    odometry: Array
    measurements: Array
    in_range: Mask

    def first_turn(self, setting: Setting) -> float:
        """Return the error of the first step's heading over its standard deviation."""
        error = self.odometry[0, 2] - setting.dt * setting.turn_rate
        return float(error / setting.motion_sigmas[2])


def simulate(setting: Setting, rng: np.random.Generator) -> Trial:
    """Return a run with random noise; the true path is fixed."""
    truth, landmarks = setting.path(), setting.ring()
    odometry = setting.dt * np.array([setting.speed, 0.0, setting.turn_rate])
    odometry = odometry + setting.motion_sigmas * rng.standard_normal((setting.steps - 1, 3))
    exact = np.array([transform(inverse(pose), landmarks) for pose in truth[1:]])
    distance = np.hypot(exact[..., 0], exact[..., 1])
    in_range = (distance > setting.min_range) & (distance < setting.max_range)
    measurements = exact + setting.sigma * rng.standard_normal(exact.shape)
    return Trial(truth, odometry, measurements, in_range)
