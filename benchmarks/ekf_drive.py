"""Time of a step on a drive through worlds of 100 to 10,000 landmarks, and of the complete map at its end.

    python benchmarks/ekf_drive.py                   # submaps
    python benchmarks/ekf_drive.py ekf 100 400       # any other filter, and sizes
    python benchmarks/ekf_drive.py --lanes           # the same world, crossed from end to end

Landmarks are about 5 m apart. At each step of 0.25 m the nearest ten within 9 m are observed. The robot
drives lanes 10 m apart in one block of 100 m after the other, and finally along both diagonals and edges,
through known areas. With `--lanes` each lane crosses the whole world: the hardest order for submaps,
because the longest border is crossed most often. Times are CPU times of all steps, including changes of
areas (in `predict`), and of the whole map at the end.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.association.mahalanobis import Mahalanobis
from impslam.component import build
from impslam.filters.base import Filter
from impslam.geometry.se2 import compose, inverse, transform
from impslam.landmarks.point import Cylinder
from impslam.types import Array, Increment, Observation

SIZES = (100, 400, 1600, 4900, 10000)
APART, RANGE, SEEN, STEP, LANE, BLOCK = 5.0, 9.0, 10, 0.25, 10.0, 100.0  # m
R = np.eye(2) * 1e-4  # 1 cm
Q = np.diag([0.01, 0.005, 0.005]) ** 2


def main(arguments: list[str]) -> None:
    """Print a row for each size."""
    whole = "--lanes" in arguments
    words = [word for word in arguments if not word.startswith("-")]
    kind = next((word for word in words if not word.isdigit()), "submaps")
    sizes = [int(word) for word in words if word.isdigit()] or SIZES
    print(f"{kind}: mean ms of a step, {'lanes through the world' if whole else 'block by block'}")
    print("landmarks   steps  handled  predict  associate  correct  extend    map     all  error")
    for size in sizes:
        print(row(kind, size, whole), flush=True)


def row(kind: str, size: int, whole: bool) -> str:
    """Drive through a world of a size; return a row of times."""
    world, rng, association = World(size), np.random.default_rng(1), Mahalanobis()
    belief: Filter = build("filter", {"kind": kind})
    path = way_points(world.side, world.side if whole else BLOCK)
    belief.start(np.array([*path[0], 0.0]), 1e-6 * np.eye(3), {"cylinder": Cylinder()})
    spent, handled, steps = np.zeros(5), 0, 0
    for pose, motion in drive(path, rng):
        seen = world.seen(pose, rng)
        times = [time.process_time()]
        belief.predict(motion)
        times.append(time.process_time())
        choice = belief.associate(seen, association)
        times.append(time.process_time())
        belief.correct(seen, choice.matches)
        times.append(time.process_time())
        belief.note(seen, choice.matches, motion.stamp)
        belief.extend([seen[i] for i in choice.new], motion.stamp)
        times.append(time.process_time())
        spent[:4] += np.diff(times)
        handled, steps = handled + len(belief.outlines()[0]), steps + 1
    begin = time.process_time()
    found = len(belief.landmarks())
    spent[4] = time.process_time() - begin
    ms = 1e3 * spent / steps
    error = math.hypot(*(pose - belief.pose)[:2])
    return (
        f"{found:9d} {steps:7d} {handled / steps:8.1f} {ms[0]:8.3f} {ms[1]:10.3f} {ms[2]:8.3f}"
        f" {ms[3]:7.3f} {ms[4]:6.3f} {ms.sum():7.3f} {error:6.3f}"
    )


class World:
    """Landmarks, indexed by the grid square that contains them."""

    def __init__(self, size: int) -> None:
        count = math.isqrt(size)
        self.side = APART * count
        x, y = np.meshgrid(np.arange(count), np.arange(count))
        jitter = np.random.default_rng(0).uniform(-0.3, 0.3, (count * count, 2))
        self.places = APART * (np.stack([x.ravel(), y.ravel()], 1) + jitter)
        self.squares: dict[tuple[int, ...], list[int]] = {}
        for i, square in enumerate((self.places // RANGE).astype(int).tolist()):
            self.squares.setdefault(tuple(square), []).append(i)

    def seen(self, pose: Array, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the nearest landmarks as seen from a pose (3,)."""
        i, j = (pose[:2] // RANGE).astype(int).tolist()
        around = [(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        near = [k for square in around for k in self.squares.get(square, ())]
        points = transform(inverse(pose), self.places[near])
        far = np.hypot(*points.T)
        nearest = [k for k in np.argsort(far)[:SEEN] if far[k] < RANGE]
        noisy = points[nearest] + rng.normal(0.0, 0.01, (len(nearest), 2))
        return tuple(Observation("cylinder", z, R) for z in noisy)


def way_points(side: float, block: float) -> Array:
    """Return way points (k, 2): lanes block by block, and back along edges and diagonals."""
    low, high = 0.5 * LANE, side - 0.5 * LANE
    points, rightward = [[low, low]], True
    for row_ in np.arange(0.0, side, block):
        columns = np.arange(0.0, side, block)
        for column in columns if rightward else columns[::-1]:
            begin, end = column + 0.5 * LANE, min(column + block, side) - 0.5 * LANE
            for k, lane in enumerate(np.arange(row_ + 0.5 * LANE, min(row_ + block, side), LANE)):
                ends = [begin, end] if (k % 2 == 0) == rightward else [end, begin]
                points += [[x, lane] for x in ends]
        rightward = not rightward
    return np.array([*points, [high, high], [low, low], [high, low], [low, high], [low, low]])


def drive(points: Array, rng: np.random.Generator) -> Iterator[tuple[Array, Increment]]:
    """Yield poses (3,) and measured motions along the points, with turns of up to 0.3 rad per step."""
    pose, stamp = np.array([*points[0], 0.0]), 0.0
    for point in points[1:]:
        while math.hypot(*(point - pose[:2])) > 2.0 * STEP:
            ahead = math.atan2(*(point - pose[:2])[::-1]) - pose[2]
            turn = (ahead + math.pi) % (2.0 * math.pi) - math.pi
            d = np.array([STEP if abs(turn) < 0.5 else 0.3 * STEP, 0.0, np.clip(turn, -0.3, 0.3)])
            pose, stamp = compose(pose, d), stamp + 0.25
            yield pose, Increment(stamp, d + rng.multivariate_normal(np.zeros(3), Q), Q, 0.25)


if __name__ == "__main__":
    main(sys.argv[1:])
