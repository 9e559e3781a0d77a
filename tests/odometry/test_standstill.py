"""A stationary robot has no motion and no growing covariance, and loses none of its drive."""

import math
from functools import reduce

import numpy as np
import pytest

from impslam.columns import batches, join
from impslam.config import load
from impslam.geometry.se2 import compose
from impslam.odometry.stream import OdometryStream
from impslam.platform.virtual.wheel_encoders import AbsoluteEncoder
from impslam.types import WheelAngles

STEP = 2.0 * math.pi / 4096


def motions(left, right, rate=100.0, jitter=None, cut=None):
    """The motions of the preset `imp` from readings (m,) in rad, given in batches of `cut` rows."""
    settings = [] if jitter is None else [f"odometry.jitter={jitter}"]
    stream = OdometryStream(load("imp", settings).make_robot().odometry)
    rows = [WheelAngles(k / rate, *both) for k, both in enumerate(zip(left, right, strict=True))]
    columns = reduce(join, (b["wheels"] for b in batches(("wheels", row) for row in rows)))
    cut = cut or len(columns)
    parts = [
        stream.motions(columns.take(slice(k, k + cut))).motions for k in range(0, len(rows), cut)
    ]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def read(angles, seed=0):
    """Two MA3 encoders at the same angles (m,) in rad, as accumulated readings."""
    rng = np.random.default_rng(seed)
    sides = []
    for phase in rng.uniform(0.0, 2.0 * math.pi, 2):
        encoder = AbsoluteEncoder(rng)
        steps = [encoder.read(angle + phase, 0.01 * k) for k, angle in enumerate(angles)]
        sides.append(STEP * np.unwrap(steps, period=4096))
    return sides


def end_of(d_pose):
    pose = np.zeros(3)
    for step in d_pose[~np.isnan(d_pose[:, 0])]:
        pose = compose(pose, step)
    return pose


def test_ten_minutes_at_rest_move_nothing():
    _, d_pose, covariance, _ = motions(*read(np.zeros(60_000)))
    end = end_of(d_pose)
    assert np.hypot(end[0], end[1]) < 1e-3
    assert abs(end[2]) < math.radians(0.05)
    assert np.nansum(covariance, axis=0).max() == 0.0
    _, d_pose, covariance, _ = motions(*read(np.zeros(6_000)), jitter=0.0)
    assert np.nansum(np.abs(d_pose[:, 2])) > 0.5  # what it would count for in a minute


def test_a_drive_after_a_rest_keeps_all_of_its_distance():
    rest = np.zeros(300)
    angles = np.concatenate([rest, np.linspace(0.0, 6.0, 400), np.full(300, 6.0)])
    left, right = read(angles)
    held = end_of(motions(left, right)[1])
    raw = end_of(motions(left, right, jitter=0.0)[1])
    assert 0.37 < held[0] < 0.39  # 6 rad of a wheel of 63.5 mm
    np.testing.assert_allclose(held[:2], raw[:2], atol=4e-4)  # the jitter at the end
    assert abs(held[2] - raw[2]) < 2e-3


@pytest.mark.parametrize("speed", [2e-3, 0.02, 0.3])
def test_the_slowest_drive_lags_by_the_band_at_most(speed):
    angles = speed / 0.0635 * np.arange(1000) / 100.0
    d_pose = motions(angles, angles)[1]
    way = np.cumsum(np.nan_to_num(d_pose[:, 0]))
    np.testing.assert_allclose(way, 0.0635 * angles, atol=0.0635 * 0.0061 + 1e-9)


@pytest.mark.parametrize("cut", [1, 7])
def test_cutting_the_readings_changes_no_byte(cut):
    angles = np.concatenate([np.zeros(120), np.linspace(0.0, 1.0, 100), np.ones(120)])
    left, right = read(angles)
    right[200] = math.nan
    whole, parts = motions(left, right), motions(left, right, cut=cut)
    for one, other in zip(whole, parts, strict=True):
        assert one.tobytes() == other.tobytes()
