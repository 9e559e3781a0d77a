"""Time per scan of FastSLAM with ten observations, for maps of several sizes.

    python benchmarks/particles.py                      # 100 particles; 100, 1000 and 10000 landmarks
    python benchmarks/particles.py --version 1 --particles 1000

Times are the median of process time over scans, in ms. The map is a grid of 2 m along a lane; the robot
drives along it, observes the ten nearest points and associates them by their positions.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from impslam.component import build
from impslam.estimators.particles import Particles
from impslam.geometry.se2 import compose, inverse, transform
from impslam.map import Keyframe
from impslam.types import Array, Increment, Observation

STEP = np.array([0.25, 0.0, 0.0])
Q = np.diag([0.01, 0.005, 0.005]) ** 2
R = 0.02**2 * np.eye(2)
SEEN, SCANS = 10, 60


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--particles", type=int, default=100)
    options.add_argument("--version", type=int, default=2)
    options.add_argument("--landmarks", type=int, nargs="+", default=[100, 1000, 10000])
    given = options.parse_args()
    print(f"FastSLAM {given.version}, {given.particles} particles, {SEEN} observations a scan")
    for landmarks in given.landmarks:
        times = scans(given.particles, given.version, landmarks)
        low, median, high = 1e3 * np.quantile(times, [0.05, 0.5, 0.95])
        print(f"{landmarks:6d} landmarks  {median:6.2f} ms  (5 to 95 %: {low:.2f} to {high:.2f})")


def scans(particles: int, version: int, landmarks: int) -> Array:
    """Return the process times (SCANS,) of scans in a map of so many landmarks, s."""
    rng, made = np.random.default_rng(0), Particles(particles=particles, version=version)
    parts = {"filter": "ekf", "association": "mahalanobis", "lifecycle": "immediate"}
    models = {"cylinder": build("landmark", {"kind": "cylinder"})}
    made.start(np.zeros(3), models=models, **{r: build(r, {"kind": k}) for r, k in parts.items()})
    places = _places(landmarks)
    still = Increment(0.0, np.zeros(3), 0.0 * Q, 0.0)
    made.add(_keyframe(0, still, _seen(np.zeros(3), places, rng)))
    pose, times = np.zeros(3), []
    for k in range(1, SCANS + 10):
        pose = compose(pose, STEP)
        motion = STEP + rng.multivariate_normal(np.zeros(3), Q)
        near = np.argsort(np.hypot(*(places - pose[:2]).T))[:SEEN]
        keyframe = _keyframe(k, Increment(float(k), motion, Q, 1.0), _seen(pose, places[near], rng))
        begin = time.process_time()
        made.add(keyframe)
        times.append(time.process_time() - begin)
    assert made.state_size == 3 + 2 * landmarks, "a landmark was lost or doubled"
    return np.array(times[-SCANS:])


def _places(landmarks: int) -> Array:
    """Return positions (n, 2) on a grid of 2 m, ten of them across the lane."""
    column, row = np.divmod(np.arange(landmarks), 10)
    return np.column_stack([2.0 * column - 4.0, 2.0 * row - 9.0])


def _seen(pose: Array, places: Array, rng: np.random.Generator) -> tuple[Observation, ...]:
    z = transform(inverse(pose), places) + rng.multivariate_normal(np.zeros(2), R, len(places))
    return tuple(Observation("cylinder", one, R) for one in z)


def _keyframe(k: int, motion: Increment, seen: tuple[Observation, ...]) -> Keyframe:
    none = np.zeros((3, 3))
    return Keyframe(k, motion.stamp, motion, none[0], none[0], none, None, 0, observations=seen)


if __name__ == "__main__":
    main()
