"""A small made-up run: a robot that drives a circle in a square room with one column."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tests.sensing import at_rest

from impslam.columns import Columns, Scans, Sweeps
from impslam.geometry.se2 import between, compose, compose_jacobians, inverse, transform
from impslam.map import Keyframe, Revision, Track
from impslam.map_builder import MapBuilder
from impslam.observers.base import Dropped, Outcome
from impslam.observers.health import HealthMonitor
from impslam.types import Landmark, LaserScan, Match, Observation, Scan, TruePose

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


@dataclass
class Result:
    """What one scan did."""

    stamp: float
    pose: np.ndarray
    covariance: np.ndarray
    odometry: np.ndarray
    scan: Scan | None
    matches: tuple = ()
    added: tuple = ()


def make_results(n=50, seed=1):
    rng = np.random.default_rng(seed)
    drift = np.zeros(3)
    for i, true in enumerate(poses(n)):
        stamp = 1300000000.125 + 0.1 * i
        sigma = np.array([0.004, 0.005, 0.002]) * (1 - np.exp(-i / 20.0)) + 1e-9
        pose = true + sigma * rng.standard_normal(3)
        pose[2] = np.pi - (np.pi - pose[2]) % (2 * np.pi)
        drift = drift + rng.normal(0.0, 0.002, 3)
        innovation = 0.01 * rng.standard_normal(2)
        match = Match(0, 7, innovation, 1e-4 * np.eye(2), float(innovation @ innovation / 1e-4))
        scan, known = make_scan(stamp, true), i > 0
        yield Result(
            stamp, pose, np.diag(sigma**2), true + drift, scan, (match,) * known, (7,) * (not known)
        )


class Scripted:
    """A run whose results are given: its map grows, and observers see what a run shows them."""

    def __init__(self, *observers, landmarks=tuple):
        self._health = HealthMonitor()
        self.observers = (self._health, *observers)
        self.builder, self.landmarks = MapBuilder(), landmarks
        self._last, self._count = None, 0

    def step(self, result, *, keyframe=True):
        """Show a result, as a keyframe or as a scan that hangs on the last one."""
        sweeps = sweeps_of(result)
        if keyframe:
            self._keyframe(result, sweeps)
        else:
            T = between(self._last.pose, result.pose)[None]
            of_anchor, of_motion = compose_jacobians(self._last.pose, T[0])
            known = of_anchor @ self._last.covariance @ of_anchor.T
            spread = (of_motion.T @ (result.covariance - known) @ of_motion)[None]
            track = Track(
                self._count - 1, np.array([result.stamp]), T, spread, result.odometry[None],
                sweeps, slice(0, 1), np.zeros(1, bool), np.zeros(1, np.int8), np.zeros(1), None,
            )  # fmt: skip
            path = self.builder.follow(track)
            for observer in self.observers:
                observer.follow(track, path)

    def _keyframe(self, result, sweeps):
        none, grown = np.zeros((3, 3)), np.zeros(3)
        if self._last is not None:
            grown = np.maximum(0.0, np.diag(result.covariance - self._last.covariance))
        motion = replace(at_rest(result.stamp), covariance=np.diag(grown))
        seen = tuple(Observation("corner", np.zeros(2), np.eye(2)) for _ in result.matches)
        keyframe = Keyframe(
            self._count, result.stamp, motion, result.odometry, none[0],
            none, sweeps, 0, result.scan, observations=seen,
        )  # fmt: skip
        revision = Revision(
            np.array([self._count]), result.pose[None], result.covariance[None], result.matches,
            result.added,
        )  # fmt: skip
        path = self.builder.revise(keyframe, revision)
        self._count += 1
        self._last = result
        for observer in self.observers:
            observer.revise(keyframe, revision, path)

    def newest_health(self):
        return self._health.newest

    def keyframes(self):
        return self.builder.keyframes()

    def draft_landmarks(self):
        marks = tuple(self.landmarks())
        return lambda: marks

    def map(self):
        return replace(self.builder.map(), landmarks=tuple(self.landmarks()))


def sweeps_of(result):
    """Return the result's scan as the one row of its sensor."""
    scan = result.scan
    none = np.zeros((1, 3, 3))
    columns = Columns(
        "scan", LaserScan, np.zeros(1, np.int64), {"stamp": np.array([result.stamp])}, {}
    )
    scans = scan and Scans(
        np.array([scan.stamp]), scan.angles, scan.ranges[None], scan.valid[None], scan.points[None],
        scan.directions[None], scan.origins[None], scan.sigmas[None], scan.bias, scan.range_max,
        scan.laser,
    )  # fmt: skip
    return Sweeps("lidar", columns, columns.stamps, none[0], none[0], none, scans)


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
            "grid": {"resolution": 0.05},
        },
        "counts": {"LaserScan": n + 2, "steps": n, "landmarks": 2},
        "dropped": {"nan ranges": Dropped(2, "scan at 3.2 s: all <NaN>; check the lidar")},
        "stages": {"sensor": rng.gamma(4.0, 1e-4, n), "slam": rng.gamma(4.0, 2e-4, n)},
        "log_seconds": 0.1 * n,
        "wall_seconds": 0.02,
        "state_size": 7,
    }
    return Outcome(**{**facts, **changes})


def play(observers, n=50, truth=None, outcome=None, landmarks=None):
    """Show a whole run; each fifth scan stands between two keyframes."""
    for pose in truth or ():
        for observer in observers:
            observer.truth(pose)
    run = Scripted(*observers, landmarks=make_landmarks if landmarks is None else lambda: landmarks)
    for i, result in enumerate(make_results(n)):
        run.step(result, keyframe=i % 5 != 3)
    known = run.map()
    for observer in observers:
        observer.finish(known, outcome or make_outcome(n))
    return known


def relative(frame, points):
    return transform(inverse(np.array(frame)), points)
