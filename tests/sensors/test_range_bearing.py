"""A sensor that detects landmarks itself: what it measured, seen from base_link."""

import math

import numpy as np
from tests.odometry_steps import stacked

from impslam.columns import Sweeps
from impslam.geometry.se2 import transform
from impslam.sensors.range_bearing import RangeBearing
from impslam.types import Detections

RNG = np.random.default_rng(0)


def detections(ranges, bearings, labels=None, diameters=None):
    n = len(ranges)
    return Detections(
        7.0,
        np.array(ranges, np.float64),
        np.array(bearings, np.float64),
        np.full(n, -1) if labels is None else np.array(labels, np.int64),
        np.full(n, np.nan) if diameters is None else np.array(diameters, np.float64),
    )


def observe(sensor, message):
    columns, nothing = stacked([message]), np.zeros((1, 3))
    assert sensor.sweeps(columns, nothing) is None
    sweeps = Sweeps("camera", columns, nothing[0], nothing, nothing, np.zeros((1, 3, 3)), None)
    return sensor.observe(sweeps, 0, RNG)


def test_a_detection_is_where_the_mount_and_the_bearing_put_it():
    sensor = RangeBearing(mount=(1.0, 2.0, math.pi / 2))
    (seen,) = observe(sensor, detections([3.0], [math.pi / 2], [5], [0.4]))
    np.testing.assert_allclose(seen.z, [-2.0, 2.0], atol=1e-12)
    assert (seen.kind, seen.label, dict(seen.attributes)) == ("point", 5, {"radius": 0.2})


def test_its_covariance_is_that_of_many_noisy_detections():
    sensor = RangeBearing(
        mount=(0.3, -0.2, 0.7), sigma_range=0.02, sigma_range_per_m=0.01, sigma_bearing=0.02
    )
    (seen,) = observe(sensor, detections([4.0], [0.5]))
    noise = RNG.standard_normal((200_000, 2)) * [0.02 + 0.01 * 4.0, 0.02]
    r, bearing = 4.0 + noise[:, 0], 0.5 + noise[:, 1]
    places = transform(
        np.array(sensor.mount), np.stack([r * np.cos(bearing), r * np.sin(bearing)], 1)
    )
    np.testing.assert_allclose(seen.R, np.cov(places.T), rtol=0.02, atol=2e-5)


def test_what_is_not_finite_or_out_of_limits_is_left_out():
    sensor = RangeBearing(range_min=0.5, range_max=6.0)
    message = detections([1.0, math.nan, 0.4, 6.1, -1.0, 2.0], [0.0, 0.0, 0.0, 0.0, 0.0, math.inf])
    assert len(observe(sensor, message)) == 1


def test_a_row_of_nothing_finite_is_not_usable_and_an_empty_one_is():
    sensor, nan = RangeBearing(), math.nan
    rows = stacked([detections([nan, nan], [0.0, 0.0]), detections([nan, 2.0], [0.0, 0.0])])
    assert sensor.usable(rows).tolist() == [False, True]
    assert "no detection at 7.000 s is finite" in sensor.fault(rows.row(0))
    assert sensor.usable(stacked([detections([], [])])).tolist() == [True]
    assert observe(sensor, detections([], [])) == ()


def test_late_stamps_are_taken_back():
    rows = stacked([detections([3.0], [0.0])])
    assert RangeBearing().spans(rows) == ([7.0], [7.0])
    assert RangeBearing(latency=0.25).spans(rows) == ([6.75], [6.75])


def test_depth_becomes_range_with_its_own_covariance():
    """A camera sees [3, 4] m at a depth of 3 m; the covariance is that of noise on depth, bearing."""
    depth, bearing = 3.0 / 1.25, math.atan2(4.0, 3.0)
    sensor = RangeBearing(depth=True, range_scale=1.25, sigma_range=0.02, sigma_bearing=0.005)
    (seen,) = observe(sensor, detections([depth], [bearing]))
    np.testing.assert_allclose(seen.z, [3.0, 4.0], atol=1e-12)
    noise = RNG.standard_normal((400_000, 2)) * [0.02, 0.005]
    x, b = 3.0 + noise[:, 0], bearing + noise[:, 1]
    np.testing.assert_allclose(seen.R, np.cov(x, x * np.tan(b)), rtol=0.02, atol=1e-5)


def test_nothing_has_a_depth_beside_or_behind_the_camera():
    message = detections([1.0, 1.0, 1.0], [0.5, 1.6, math.pi])
    assert len(observe(RangeBearing(depth=True), message)) == 1
    assert len(observe(RangeBearing(), message)) == 3
