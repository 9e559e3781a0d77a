"""A small made-up run: a robot that drives a circle in a square room with one column."""

from pathlib import Path

import numpy as np

from impslam.geometry.se2 import compose, inverse, transform
from impslam.observers.base import Dropped, Outcome
from impslam.types import Landmark, Match, Observation, Scan, StepResult, TruePose

HALF = 3.0
ANGLES = np.linspace(-np.pi, np.pi, 90, endpoint=False)


def poses(n):
    turn = np.linspace(0.0, 2 * np.pi, n)
    return np.c_[np.sin(turn), 1.0 - np.cos(turn), turn]


def make_scan(stamp, pose):
    """A noiseless scan of the room's four walls."""
    c, s = np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])
    with np.errstate(divide="ignore"):
        x = np.where(c > 0, HALF - pose[0], -HALF - pose[0]) / c
        y = np.where(s > 0, HALF + 1 - pose[1], -HALF + 1 - pose[1]) / s
    ranges = np.minimum(np.abs(x), np.abs(y))
    points = np.c_[ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)]
    zeros = np.zeros((len(ANGLES), 2))
    valid = np.ones(len(ANGLES), bool)
    sigmas = np.full(len(ANGLES), 0.01)
    return Scan(stamp, ANGLES, ranges, valid, points, ANGLES, zeros, sigmas, 0.0, 10.0, np.zeros(3))


def make_results(n=50, seed=1):
    rng = np.random.default_rng(seed)
    drift = np.zeros(3)
    for i, true in enumerate(poses(n)):
        stamp = 1300000000.125 + 0.1 * i
        sigma = np.array([0.004, 0.005, 0.002]) * (1 - np.exp(-i / 20.0)) + 1e-9
        pose = true + sigma * rng.standard_normal(3)
        drift = drift + rng.normal(0.0, 0.002, 3)
        innovation = 0.01 * rng.standard_normal(2)
        match = Match(0, 7, innovation, 1e-4 * np.eye(2), float(innovation @ innovation / 1e-4))
        seen = Observation("cylinder", np.array([1.0, 0.0]), 1e-4 * np.eye(2))
        yield StepResult(
            stamp, pose, np.diag(sigma**2), true + drift, pose, make_scan(stamp, true),
            (seen,), (match,) if i else (), () if i else (7,), (),
        )  # fmt: skip


def make_truth(n=50, frame=(0.0, 0.0, 0.0)):
    for i, pose in enumerate(poses(n)):
        yield TruePose(1300000000.125 + 0.1 * i, compose(np.array(frame), pose))


def make_landmarks():
    ends = np.array([[HALF, -2.0], [HALF, 4.0]])
    near = np.array([0.004, -0.003])
    column = Landmark(
        7, "cylinder", np.array([0.0, 1.0]) + near, {"radius": 0.1}, 4e-5 * np.eye(2), None, 49,
        1300000000.125, 1300000005.0,
    )  # fmt: skip
    wall = Landmark(
        8, "wall", np.array([HALF, 0.0]), {"r": HALF, "alpha": 0.001}, np.diag([1e-4, 1e-5]), ends,
        30, 1300000001.0, 1300000004.0,
    )  # fmt: skip
    return (column, wall)


def make_outcome(n=50, **changes):
    rng = np.random.default_rng(4)
    facts = {
        "log": Path("room.log"),
        "log_sha256": "ab" * 32,
        "config": {
            "seed": 3,
            "odometry": {"kind": "encoders", "track": 0.3, "none": None},
            "start": (0.0, 0.0, 0.0),
        },
        "counts": {"LaserScan": n + 2, "steps": n, "landmarks": 2},
        "dropped": {"nan ranges": Dropped(2, "scan at 3.2 s: all <NaN>; check the lidar")},
        "stages": {"sensor": rng.gamma(4.0, 1e-4, n), "slam": rng.gamma(4.0, 2e-4, n)},
        "log_seconds": 0.1 * n,
        "wall_seconds": 0.02,
        "landmarks": make_landmarks(),
        "state_size": 7,
    }
    return Outcome(**{**facts, **changes})


def play(observers, n=50, truth=None, outcome=None):
    for pose in truth or ():
        for observer in observers:
            observer.truth(pose)
    for result in make_results(n):
        for observer in observers:
            observer.step(result)
    for observer in observers:
        observer.finish(outcome or make_outcome(n))


def relative(frame, points):
    return transform(inverse(np.array(frame)), points)
