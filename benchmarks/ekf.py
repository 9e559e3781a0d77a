"""Time of a step (predict, associate 10 observations, correct) against the size of the map.

    python benchmarks/ekf.py            # the default filter and the textbook EKF
    python benchmarks/ekf.py oc         # any other

What bounds a large filter is the traffic of its covariance P through memory: a correction reads and
writes half of P once. The floor is measured beside each step, in the same process: the time to copy
as many bytes as the lower triangle of P has. Ratios to it say more than milliseconds do. Times are of the
processor: what else runs on the machine does not count.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.association.mahalanobis import Mahalanobis
from impslam.component import build
from impslam.filters.base import Filter
from impslam.geometry.se2 import inverse, transform
from impslam.landmarks.point import Cylinder
from impslam.types import Array, Increment, Observation

SIZES = (10, 20, 50, 100, 200, 500, 1000)
SEEN = 10  # observations a step
WARM, STEPS = 5, 60
R = np.eye(2) * 1e-4  # 1 cm


def main(kinds: Sequence[str]) -> None:
    """Print a table for each filter."""
    print(f"median of {STEPS} steps with {SEEN} observations, in ms")
    for kind in kinds:
        print(f"\n{kind}")
        print("landmarks  predict  associate  correct     step    floor  step/floor")
        for size in SIZES:
            predict, associate, correct = stages(kind, size)
            step, least = predict + associate + correct, floor(2 * size + 3)
            print(
                f"{size:9d} {predict:8.3f} {associate:10.3f} {correct:8.3f} {step:8.3f} {least:8.3f}"
                f" {step / least:11.1f}"
            )


def stages(kind: str, size: int) -> Array:
    """Return the median ms of prediction, association and correction with a map of a size."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-50.0, 50.0, (size, 2))
    association = Mahalanobis()
    belief: Filter = build("filter", {"kind": kind})
    belief.start(np.zeros(3), 1e-6 * np.eye(3), {"cylinder": Cylinder()})
    belief.extend(_seen(places), 0.0)
    times = []
    for k in range(WARM + STEPS):
        motion = Increment(0.1 * k, np.array([0.02, 0.0, 0.01]), 1e-5 * np.eye(3), 0.1)
        begin = time.process_time()
        belief.predict(motion)
        predicted = time.process_time()
        near = places[rng.choice(size, min(SEEN, size), replace=False)]
        seen = _seen(transform(inverse(belief.pose), near) + rng.normal(0.0, 0.01, near.shape))
        asked = time.process_time()
        choice = belief.associate(seen, association)
        answered = time.process_time()
        belief.correct(seen, choice.matches)
        times.append((predicted - begin, answered - asked, time.process_time() - answered))
    return np.asarray(1e3 * np.median(times[WARM:], axis=0))


def _seen(points: Array) -> tuple[Observation, ...]:
    return tuple(Observation("cylinder", point, R) for point in points)


def floor(n: int) -> float:
    """Return the median ms to copy the number of bytes in the lower triangle of P (n, n)."""
    source = np.ones(n * (n + 1) // 2)
    target = np.empty_like(source)
    return 1e3 * _median(lambda: np.copyto(target, source))


def _median(work: Callable[[], None]) -> float:
    times = []
    for _ in range(WARM + STEPS):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return float(np.median(times[WARM:]))


if __name__ == "__main__":
    main(sys.argv[1:] or ("riekf", "ekf"))
