"""Memory does not grow with the length of a log, except for the map."""

import math
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from tests.sources.logs import flaser, odom

from impslam.columns import batches
from impslam.config import load
from impslam.run import Run
from impslam.sources.base import recognise
from impslam.sources.recording import McapWriter
from impslam.types import LaserScan, OdometryPose

SCANS = 1500  # several batches
RATE = 10.0  # Hz
ANGLES = np.linspace(-1.5, 1.5, 90)
RANGES = 2.0 + 0.5 * np.sin(3.0 * ANGLES)


def drive(scans):
    """Yield the readings of a robot that drives in circles of 1 m."""
    for k in range(scans):
        stamp, angle = 1000.0 + k / RATE, 0.02 * k
        yield OdometryPose(stamp, np.array([math.sin(angle), 1.0 - math.cos(angle), angle]))
        yield LaserScan(stamp, ANGLES, RANGES, 1e-4 * np.arange(len(ANGLES)), 0.1, 8.0)


def write_mcap(path, scans):
    with McapWriter(path) as writer:
        for message in drive(scans):
            writer.write(message)


def write_carmen(path, scans):
    pairs = ((odom(10.0 + k / RATE), flaser(10.05 + k / RATE)) for k in range(scans))
    path.write_text("\n".join(line for pair in pairs for line in pair) + "\n")


def write_csv(path, scans):
    header = ["stamp", "x", "y", "theta", *(f"r{k}" for k in range(len(ANGLES)))]
    rows = ([10.0 + k / RATE, 0.1 * k, 0.0, 0.0, *RANGES] for k in range(scans))
    path.write_text("\n".join(",".join(map(str, row)) for row in (header, *rows)) + "\n")


def memory_of_reading(path, **given):
    """Return the peak memory in bytes while the batches of a log are read and forgotten."""
    with recognise(path)(path=path, **given) as source:
        tracemalloc.start()
        try:
            for _ in source.batches():
                pass
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize(
    ("write", "given"),
    [
        (write_carmen, {}),
        (write_csv, {"angle_min": -1.5, "angle_step": 0.03}),
        (write_mcap, {}),
    ],
)
def test_reading_a_longer_log_takes_no_more_memory(write, given, tmp_path):
    peaks = []
    for scans in (SCANS, 4 * SCANS):
        write(tmp_path / f"{scans}.log", scans)
        peaks.append(memory_of_reading(tmp_path / f"{scans}.log", **given))
    assert peaks[1] < 1.1 * peaks[0]


NO_KEYFRAMES = [
    "tracker.kind=odometry", "estimator.kind=landmarks",
    "keyframes.distance=50", "keyframes.angle=inf", "keyframes.seconds=10000",
]  # fmt: skip


def test_a_run_keeps_nothing_of_a_sweep_but_its_row_in_the_map():
    run, sizes = Run(load("default", NO_KEYFRAMES)), []
    tracemalloc.start()
    try:
        for batch in batches((type(m).__name__, m) for m in drive(6 * SCANS)):
            run.feed(batch)
            sizes.append((run.scans, tracemalloc.get_traced_memory()[0]))
    finally:
        tracemalloc.stop()
    known = run.map()
    columns = (getattr(known, field.name) for field in fields(known))
    row = sum(c.nbytes for c in columns if isinstance(c, np.ndarray)) / run.scans
    assert row < 250  # seven columns: poses, covariances, stamps
    (before, least), (after, most) = sizes[len(sizes) // 3], sizes[-1]
    assert after - before > 3 * SCANS
    # An array that grows has up to twice as many rows as it uses.
    assert most - least < 2 * row * (after - before)
    assert 2 * row < RANGES.nbytes  # which is therefore not kept either


@pytest.mark.parametrize("preset", ["default", "imp"])
def test_a_robot_at_rest_keeps_a_few_scans_and_their_observations(preset):
    """Some presets add a keyframe every half second, moving or not."""
    run = Run(load(preset, ["odometry.kind=odometry_pose"]))
    still = [replace(m, pose=np.zeros(3)) if isinstance(m, OdometryPose) else m for m in drive(300)]
    for batch in batches((type(m).__name__, m) for m in still):
        run.feed(batch)
    known = run.map()
    keyframes, seen = known.keyframes, [row for row in known.observations if row]
    assert 1 <= len(seen) <= 5
    assert np.count_nonzero(np.diff(keyframes.starts)) <= 5
    assert len(keyframes.points) <= 5 * len(ANGLES)
