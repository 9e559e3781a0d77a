"""A scan that is refused gives its motion back, whole and at its own time."""

import numpy as np
import pytest

from impslam.config import load
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
            n = 0 if i == empty_at else 50
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
