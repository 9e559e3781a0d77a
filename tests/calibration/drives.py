"""Drives with known parameters: odometry and a lidar's motions, made without scans."""

import numpy as np

from impslam.calibration.odometry_models import DifferentialDrive, ScaledTwists
from impslam.calibration.residuals import CalibrationDrive, lidar_poses
from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.se2 import between

TRUE = np.array([0.05, 1.01, 0.31, 0.12, -0.03, 0.4, 0.06, 0.0, 1.0])
"""wheel_radius, right_left_ratio, track, then `LIDAR_PARAMETERS`."""
SCALES = np.array([0.95, 1.06, 0.02, 0.12, -0.03, 0.4, 0.06, 0.0, 1.0])
"""distance_scale, turn_scale, turn_per_metre, then `LIDAR_PARAMETERS`."""
RATE, SPAN, MATCH = 50.0, 0.8, np.array([0.001, 0.001, 0.0007, 0.002])
"""Hz of odometry, s of a motion, and standard deviations of `LidarMotions.joint`."""


def winding(seconds):
    """Return constantly changing speeds m/s and turn rates rad/s (n,)."""
    t = np.arange(int(seconds * RATE)) / RATE
    speed = 0.3 + 0.2 * np.sin(0.7 * t) + 0.1 * np.sin(1.9 * t + 1.0)
    return speed, 0.6 * np.sin(0.41 * t) + 0.5 * np.sin(1.3 * t + 0.5)


def wheels(seconds, rng=None, noise=0.0, true=TRUE):
    """Return true and measured wheels; `noise` is in m/sqrt(m)."""
    radius, ratio, track = true[:3]
    speed, rate = winding(seconds)
    right, left = speed + 0.5 * track * rate, speed - 0.5 * track * rate
    left, right = left / RATE / radius, right / RATE / radius / ratio
    stamps = np.arange(len(speed) + 1) / RATE
    known = np.zeros(len(speed), bool)
    exact = DifferentialDrive(stamps, known, left, right)
    if noise == 0.0:
        return exact, exact
    off = [
        rng.normal(0.0, noise * np.sqrt(np.abs(w) * radius)) / radius for w in (left, right * ratio)
    ]
    return exact, DifferentialDrive(stamps, known, left + off[0], right + off[1] / ratio)


def twists(seconds, true=SCALES, rng=None, noise=(0.0, 0.0)):
    """Return odometry that measures motions, with noise of the readings, m/sqrt(m) and rad/sqrt(rad)."""
    speed, rate = winding(seconds)
    x = speed / true[0]
    steps = np.column_stack((x, np.zeros_like(x), (rate - true[2] * x) / true[1])) / RATE
    if rng is not None:
        for j, sigma in ((0, noise[0]), (2, noise[1])):
            steps[:, j] += sigma * np.sqrt(np.abs(steps[:, j])) * rng.normal(size=len(steps))
    names = ("distance_scale", "turn_scale", "turn_per_metre")
    return ScaledTwists(names, np.arange(len(x) + 1) / RATE, np.zeros(len(x), bool), steps)


def drive(exact, read=None, true=TRUE, rng=None):
    """Return a drive; with a generator, the lidar's motions have errors of `MATCH`."""
    begins = np.arange(1.0, exact.stamps[-1] - 2.0, SPAN + 0.02)
    ends = begins + SPAN
    poses = lidar_poses(
        CalibrationDrive(exact, none()), true, np.concatenate(([0.5], begins, ends))
    )
    moved = between(poses[1 : len(begins) + 1], poses[len(begins) + 1 :])
    joint = np.column_stack((moved, np.zeros(len(moved))))
    if rng is not None:
        joint = joint + rng.normal(0.0, MATCH, joint.shape)
    information = np.tile(np.diag(MATCH**-2.0), (len(moved), 1, 1))
    one = np.ones(len(moved))
    return CalibrationDrive(
        read or exact, LidarMotions(begins, ends, joint[:, :3], joint, information, one, one)
    )


def none():
    """Return no motions."""
    return LidarMotions(*(np.empty((0, *s)) for s in ((), (), (3,), (4,), (4, 4), (), ())))
