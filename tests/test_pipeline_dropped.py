"""A scan that is refused gives its motion back, whole and at its own time."""

from types import MethodType

import numpy as np
import pytest

from impslam.config import load
from impslam.errors import NumericalError
from impslam.pipeline import Pipeline
from impslam.types import LaserScan, WheelAngles


def scan_poses(empty_at, latency):
    """Drive along an arc that tightens, with one scan without beams; return where scans were taken."""
    blind = [f"sensors.lidar.extractors.{n}.kind=none" for n in ("walls", "cylinders", "corners")]
    pipeline = Pipeline(load("imp", [f"sensors.lidar.latency={latency}", *blind]))
    results = []
    for i in range(200):
        stamp, way = 10.0 + 0.01 * i, 0.05 * i
        results += pipeline.feed(WheelAngles(stamp, way, way + 1e-4 * i**2))
        if i % 4 == 0 and i > 40:
            n = 0 if i == empty_at else 9  # too few to tell that the robot seems to stand
            offsets = 1e-3 * np.arange(n)
            scan = LaserScan(stamp, np.linspace(-1, 1, n), np.full(n, 2.0), offsets)
            results += pipeline.feed(scan)
    return [(r.stamp, r.scan_pose) for r in results][-6:]


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_motion_of_a_refused_scan_is_kept_at_its_time(latency):
    whole, missing = scan_poses(None, latency), scan_poses(180, latency)
    known = dict(whole)
    shared = [(stamp, pose) for stamp, pose in missing if stamp in known]
    assert len(shared) >= 4
    for stamp, pose in shared:
        np.testing.assert_allclose(pose, known[stamp], atol=1e-9)


def drive_along(
    settings=(), spoilt=(), ranges=lambda k: 2.0 + 0.5 * np.sin(np.linspace(-3, 3, 80))
):
    """Drive by a matcher; scans of the stamps in `spoilt` reach a filter that refuses them."""
    pipeline = Pipeline(load("imp", ["matcher.kind=icp", *settings]))
    correct = type(pipeline.slam).step

    def step(self, increment, reading, felt=None):
        if any(abs(increment.stamp - stamp) < 1e-9 for stamp in spoilt):
            raise NumericalError("no solution")
        return correct(self, increment, reading, felt)

    pipeline.slam.step = MethodType(step, pipeline.slam)
    results = []
    for i in range(120):
        stamp, way = 10.0 + 0.01 * i, 0.05 * i
        results += pipeline.feed(WheelAngles(stamp, way, way + 1e-4 * i**2))
        if i % 10 == 0 and i > 20:
            seen = ranges(i)
            n = len(seen)
            results += pipeline.feed(LaserScan(stamp, np.linspace(-1, 1, n), seen, np.zeros(n)))
    return pipeline, results


def test_a_scan_without_a_solution_is_dropped_and_counted_and_the_run_goes_on():
    pipeline, results = drive_along(spoilt=[10.6])
    whole, all_results = drive_along()
    assert len(results) == len(all_results) - 1
    assert pipeline.problems.counts["scan"] == 1
    assert pipeline.problems.examples["scan"] == "the scan at 10.600 s is dropped: no solution"
    assert "scan" not in whole.problems.counts


def test_matcher_and_filter_drop_the_same_scan():
    """A run in which a scan was refused by the filter is that in which it never came."""
    _, refused = drive_along(spoilt=[10.6])
    _, without = drive_along(ranges=lambda k: np.empty(0) if k == 60 else 2.0 + np.zeros(80))
    _, spoilt = drive_along(spoilt=[10.6], ranges=lambda k: 2.0 + np.zeros(80))
    assert len(refused) == len(without) == len(spoilt)
    for a, b in zip(without, spoilt, strict=True):
        np.testing.assert_allclose(a.pose, b.pose, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-15)
