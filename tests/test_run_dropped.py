"""A scan that is refused gives its motion back, whole and at its own time."""

import numpy as np
import pytest
from tests.steps import Steps, feed

from impslam.config import load
from impslam.run import Run
from impslam.types import LaserScan, Observation, WheelAngles


def scan_poses(empty_at, latency):
    """Drive along an arc that tightens, with one scan without beams; return where scans were taken."""
    blind = [f"sensors.lidar.extractors.{n}.kind=none" for n in ("walls", "cylinders", "corners")]
    kept = Steps()
    run = Run(load("imp", [f"sensors.lidar.latency={latency}", *blind]), [kept])
    for i in range(200):
        stamp, way = 10.0 + 0.01 * i, 0.05 * i
        feed(run, [WheelAngles(stamp, way, way + 1e-4 * i**2)])
        if i % 4 == 0 and i > 40:
            n = 0 if i == empty_at else 9  # too few to tell that the robot seems to stand
            offsets = 1e-3 * np.arange(n)
            scan = LaserScan(stamp, np.linspace(-1, 1, n), np.full(n, 2.0), offsets)
            feed(run, [scan])
    return [(r.stamp, r.pose) for r in kept.results][-6:]


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_motion_of_a_refused_scan_is_kept_at_its_time(latency):
    whole, missing = scan_poses(None, latency), scan_poses(180, latency)
    known = dict(whole)
    shared = [(stamp, pose) for stamp, pose in missing if stamp in known]
    assert len(shared) >= 4
    for stamp, pose in shared:
        np.testing.assert_allclose(pose, known[stamp], atol=1e-9)


def drive_along(spoilt=()):
    """Drive by a matcher; in the scans of the stamps in `spoilt` an extractor finds nonsense."""
    kept = Steps()
    run = Run(load("imp", ["tracker.kind=scan_to_map", "keyframes.distance=0"]), [kept])
    observe = run.robot.observe

    def spoil(sweeps, k, rng):
        seen = observe(sweeps, k, rng)
        if any(abs(sweeps.columns.stamps[k] - stamp) < 1e-9 for stamp in spoilt):
            seen = (*seen, Observation("wall", np.array([2.0, 0.0]), np.nan * np.eye(2)))
        return seen

    run.robot.observe = spoil
    for i in range(120):
        stamp, way = 10.0 + 0.01 * i, 0.05 * i
        feed(run, [WheelAngles(stamp, way, way + 1e-4 * i**2)])
        if i % 10 == 0 and i > 20:
            ranges = 2.0 + 0.5 * np.sin(np.linspace(-3, 3, 80))
            feed(run, [LaserScan(stamp, np.linspace(-1, 1, 80), ranges, np.zeros(80))])
    return run, kept.results


def test_a_scan_without_a_solution_is_counted_and_the_run_goes_on():
    run, results = drive_along(spoilt=[10.6])
    whole, all_results = drive_along()
    assert len(results) == len(all_results)
    assert run.problems.counts["keyframe"] == 1
    assert "the scan at 10.600 s is not used for the map" in run.problems.examples["keyframe"]
    assert "keyframe" not in whole.problems.counts
    assert all(np.isfinite(r.pose).all() and np.isfinite(r.covariance).all() for r in results)
