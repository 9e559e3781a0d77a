"""Disordered stamps: times from the order of the log, and calibration with them."""

import numpy as np
import pytest
from tests.log_faults import busy, faulty, with_values

from impslam.calibration.calibrate import calibrate, extract_drives
from impslam.calibration.order_clock import MAX_DISORDER, disorder, reorder_stamps
from impslam.calibration.recording import record_batches
from impslam.columns import batches
from impslam.config import load
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan

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


def test_first_scan_on_another_clock_is_no_disorder(log):
    """Scans of a computer whose clock is 8 s behind: the first one is placed by its order."""

    def behind(columns):
        is_scan = columns.kind is LaserScan
        return with_values(columns, stamp=columns["stamp"] - 8.0) if is_scan else columns

    recording = record_batches(CONFIG, faulty(batches(log), behind))
    assert recording.scans[0].stamps[0] > recording.scans[0].stamps[1] + 7.0
    assert reorder_stamps(recording)[1] == 0.0


def test_times_by_order_are_better_than_stamps(log):
    """Stamps are off by 0.2 s, times by order by a fifth of that, except for a constant."""
    true = record_batches(CONFIG, batches(log))
    wrong = record_batches(CONFIG, faulty(batches(log), busy(log[0][1].stamp)))
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
    found = calibrate(
        CONFIG,
        extract_drives(
            CONFIG, record_batches(CONFIG, faulty(batches(log), busy(log[0][1].stamp))), "log"
        ),
    )
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
