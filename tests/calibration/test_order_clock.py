"""Disordered stamps: times from the order of the log, and calibration with them."""

import numpy as np
import pytest
from tests.log_faults import faulty, with_values

from impslam.calibration.calibrate import calibrate, extract_drives
from impslam.calibration.order_clock import MAX_DISORDER, disorder, reorder_stamps
from impslam.calibration.recording import record_batches
from impslam.columns import batches
from impslam.config import load
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan, TruePose

CONFIG = load("imp", ["odometry.track=0.44", "odometry.wheel_radius=0.062"])


@pytest.fixture(scope="module")
def log():
    """A drive through the arena, in batches, with wheels that have little noise."""
    robot = SimulatedRobot(
        encoders=WheelEncoders.perfect(track=0.41, wheel_radius=0.064, noise=1e-6),
        lidar=Lidar.perfect(sigma=0.003),
        imu=None,
    )
    return [(type(m).__name__, m) for m in simulate(load_world("arena"), robot)]


def busy(log, max_wait=0.4, late=0.05, max_late=0.8):
    """Return batches with rows stamped several at once, and some rows up to 0.8 s later still.

    The computer stamps waiting rows at random intervals of up to `max_wait` s; in a share `late` of these
    turns, the stamps are late by up to `max_late` s more.
    """
    rng = np.random.default_rng(0)
    turns = log[0][1].stamp + np.cumsum(rng.uniform(0.0, max_wait, 2000))
    extra = np.where(rng.uniform(size=2000) < late, rng.uniform(0.0, max_late, 2000), 0.0)

    def stamped(columns):
        if columns.kind is TruePose:
            return columns
        turn = np.searchsorted(turns, columns.stamps)
        since = 1e-3 * (columns.stamps - turns[turn])  # keeps the order within a turn
        return with_values(columns, stamp=turns[turn] + extra[turn] + since)

    return faulty(batches(log), stamped)


def test_ordered_stamps_are_unchanged(log):
    recording = record_batches(CONFIG, batches(log))
    found, size = reorder_stamps(recording)
    assert size == 0.0
    assert found is recording


def test_disorder_is_the_amount_by_which_stamps_run_back():
    np.testing.assert_allclose(disorder(np.arange(5.0)), 0.0)
    np.testing.assert_allclose(disorder(np.array([0.0, 3.0, 1.0, 2.0, 4.0])), [0, 2, 2, 1, 0])


def test_offset_between_devices_is_no_disorder(log):
    """Scans are written 0.3 s after they were stamped, each device in order."""

    def early(columns):
        is_scan = columns.kind is LaserScan
        return with_values(columns, stamp=columns["stamp"] - 0.3) if is_scan else columns

    _, size = reorder_stamps(record_batches(CONFIG, faulty(batches(log), early)))
    assert size == 0.0


def test_times_by_order_are_better_than_stamps(log):
    """Stamps are off by 0.2 s, times by order by a fifth of that, except for a constant."""
    true = record_batches(CONFIG, batches(log))
    wrong = record_batches(CONFIG, busy(log))
    found, size = reorder_stamps(wrong)
    assert size > MAX_DISORDER
    for before, after, right in zip(
        (*wrong.odometry, *wrong.scans),
        (*found.odometry, *found.scans),
        (*true.odometry, *true.scans),
        strict=True,
    ):
        middle = slice(len(right) // 10, -(len(right) // 10))
        assert np.std((before.stamps - right.stamps)[middle]) > 0.1
        assert np.std((after.stamps - right.stamps)[middle]) < 0.05
        assert np.all(np.diff(after.stamps[middle]) > 0.0)


def test_calibration_with_disordered_stamps(log):
    """Wheels and mount are within 4 sigma; the latency is not observable and keeps its value."""
    found = calibrate(CONFIG, extract_drives(CONFIG, record_batches(CONFIG, busy(log)), "log"))
    got = {one.name: one for one in found.parameters}
    true = {"wheel_radius": 0.064, "track": 0.41, "x": 0.15, "y": 0.0, "yaw": 0.0}
    for name, value in true.items():
        if got[name].observable:
            assert abs(got[name].value - value) < 4.0 * got[name].sigma
    assert got["wheel_radius"].observable
    assert got["wheel_radius"].sigma < 0.01 * 0.064
    assert not got["latency"].observable
    assert got["latency"].value == 0.0
    assert found.covariance[6].max() == 0.0
