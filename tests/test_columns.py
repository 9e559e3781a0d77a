"""Columns: any cutting of a log holds the same rows in the same order."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.columns import batches, log_order, single_row
from impslam.types import Event, Image, Imu, LaserScan, OdometryPose, WheelAngles

ANGLES, TIMES = np.linspace(-1.0, 1.0, 5), np.zeros(5)


def scan(stamp, angles=ANGLES, **more):
    return LaserScan(stamp, angles, stamp + np.arange(len(angles)), np.zeros(len(angles)), **more)


LOG = [
    ("odom", OdometryPose(0.0, np.array([1.0, 2.0, 3.0]))),
    ("front", scan(0.1)),
    ("front", scan(0.2)),
    ("wheels", WheelAngles(0.15, 1.0, -2.0)),
    ("front", scan(0.3, intensities=np.ones(5))),
    ("front", scan(0.4, np.linspace(0.0, 1.0, 7), range_max=4.0)),
    ("rear", scan(0.35, range_min=0.1)),
    ("imu", Imu(0.4, np.ones(3), np.zeros(3))),
    ("imu", Imu(0.5, np.ones(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))),
    ("camera", Image(0.4, "jpeg", b"abc")),
    ("events", Event(-3600.0, "warning", "urg", "stalled")),
    ("odom", OdometryPose(0.2, np.array([1.5, 2.0, 3.0]))),
]


def assert_equal(found, expected):
    assert type(found) is type(expected)
    for field in fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(b, np.ndarray):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        else:
            np.testing.assert_equal(a, b)
            assert type(a) is type(b)


def unstacked(log, size):
    return [pair for cut in batches(log, size) for pair in log_order(cut)]


@given(st.integers(1, len(LOG) + 1))
def test_a_cut_log_has_the_same_rows_in_the_same_order(size):
    found = unstacked(LOG, size)
    assert [stream for stream, _ in found] == [stream for stream, _ in LOG]
    for (_, a), (_, b) in zip(found, LOG, strict=True):
        assert_equal(a, b)


def test_order_counts_on_over_the_batches():
    orders = [c.order for cut in batches(LOG, 3) for c in cut.values()]
    assert sorted(np.concatenate(orders).tolist()) == list(range(len(LOG)))


def test_rows_that_share_a_layout_are_stacked():
    log = [("front", scan(float(k))) for k in range(4)]
    (cut,) = batches(log)
    assert cut["front"]["ranges"].shape == (4, 5)
    assert cut["front"].layout["angles"] is ANGLES
    np.testing.assert_array_equal(cut["front"].stamps, [0.0, 1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    "changed",
    [
        scan(1.0, np.linspace(0.0, 1.0, 5)),
        scan(1.0, np.linspace(-1.0, 1.0, 6)),
        scan(1.0, range_max=5.0),
        replace(scan(1.0), time_offsets=np.ones(5)),
        replace(scan(1.0), intensities=np.ones(5)),
    ],
)
def test_a_new_layout_begins_a_new_batch(changed):
    assert [len(cut["front"]) for cut in batches([("front", scan(0.0)), ("front", changed)])] == [
        1,
        1,
    ]


def test_a_live_message_is_a_batch_of_one_row():
    cut = single_row("odom", LOG[0][1], 41)
    assert cut["odom"].order.tolist() == [41]
    assert_equal(cut["odom"].row(0), LOG[0][1])


def test_some_rows_can_be_taken():
    (cut,) = batches([("front", scan(float(k))) for k in range(4)])
    some = cut["front"].take(np.array([False, True, False, True]))
    np.testing.assert_array_equal(some.stamps, [1.0, 3.0])
    assert some.order.tolist() == [1, 3]
    assert_equal(some.row(1), scan(3.0))
