"""Maps without odometry: the motion is that of the scans, and its covariance that of a match."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.recorded import Played
from tests.steps import Steps, feed

from impslam.columns import batches
from impslam.config import load
from impslam.errors import SourceError
from impslam.health import JUMPED, NONE
from impslam.noise import UNKNOWN
from impslam.odometry.lidar_only import LidarOnly
from impslam.run import Run, map_log
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan, TruePose

MOUNT = "sensors.lidar.mount=[0.15,0,0]"  # of the simulated robot


def scan(stamp, offsets=(0.0, 0.0)):
    return LaserScan(stamp, np.zeros(2), np.ones(2), np.array(offsets))


def columns(*scans):
    (batch,) = batches([("scan", message) for message in scans])
    return batch["scan"]


@pytest.fixture(scope="module")
def room():
    """A room of 3 m by 2.6 m, scanned with all the faults of a lidar; its odometry is left out."""
    robot = SimulatedRobot(encoders=None, imu=None)
    return list(simulate(load_world("room"), robot, seed=1))


def mapped(messages, folder, *settings):
    kept = Steps()
    config = load("default", ["odometry.kind=lidar_only", MOUNT, *settings])
    map_log(config, Played.of(messages, folder), [kept])
    return kept


# --------------------------------------------------------------------------- the readings


@pytest.mark.parametrize("sweep", [0.0, 0.06])
@pytest.mark.parametrize("begin", [0.0, 1.5e9])
def test_the_first_pose_is_the_origin_whenever_its_sweep_ends(room, tmp_path, sweep, begin):
    """Also if the sweep's time is that of the config, or rounding leaves some of it before the middle."""
    messages = [replace(m, stamp=begin + m.stamp) for m in room if isinstance(m, LaserScan)][:30]
    kept = mapped(messages, tmp_path, f"sensors.lidar.sweep_time={sweep}")
    assert kept.results[0].covariance[0, 0] < 1e-6
    assert max(step.covariance[0, 0] for step in kept.results) < 0.01


def test_a_motion_is_unknown_and_goes_from_middle_to_middle():
    made = LidarOnly()
    readings = made.readings(columns(scan(1.0, (0.0, 0.06)), scan(1.1, (0.0, 0.06))))
    motions = made.motions(readings)
    np.testing.assert_allclose(motions.stamps, [1.13])
    np.testing.assert_allclose(motions.duration, [0.1])
    assert not motions.d_pose.any()
    assert motions.covariance[0, 0, 0] == motions.covariance[0, 1, 1] == UNKNOWN
    assert motions.covariance[0, 2, 2] >= math.pi


def test_it_measures_no_motion():
    assert not LidarOnly.measures_motion


def test_stamps_that_run_backwards_take_no_time():
    made = LidarOnly()
    motions = made.motions(made.readings(columns(scan(2.0), scan(1.0), scan(1.5))))
    np.testing.assert_allclose(motions.duration, [0.0, 0.5])


def test_a_scan_without_a_stamp_is_a_fault_in_one_line():
    made = LidarOnly()
    readings = made.readings(columns(scan(1.0), scan(math.nan)))
    assert made.usable(readings).tolist() == [True, False]
    message = made.fault(readings)
    assert "nan" in message
    assert "\n" not in message


# --------------------------------------------------------------------------- a room


def test_a_room_is_mapped_without_odometry(room, tmp_path):
    kept = mapped(room, tmp_path)
    path = kept.known.path()
    truth = np.array([kept.truths[stamp] for stamp in path[:, 0]])
    assert len(path) == sum(isinstance(m, LaserScan) for m in room)
    # A scan of 67 ms is stamped at its begin, and the robot's motion within it is unknown: 1 cm.
    assert np.hypot(*(path[:, 1:3] - truth[:, :2]).T).max() < 0.03
    kinds = [mark.kind for mark in kept.known.landmarks]
    assert (kinds.count("wall"), kinds.count("cylinder")) == (4, 2)
    assert kept.outcome.dropped == {}


@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_covariances_are_those_of_matches_and_of_no_unknown_motion(room, tmp_path, latency):
    """A motion cut in the middle of a sweep once left its share of the unknown: 577 m."""
    kept = mapped(room, tmp_path, f"sensors.lidar.latency={latency}")
    sigmas = np.sqrt(np.diagonal(kept.known.rows().covariances, axis1=1, axis2=2))
    assert sigmas.max() < 0.15
    for mark in kept.known.landmarks:
        assert np.sqrt(np.diag(mark.covariance)).max() < 0.1
    assert all(np.linalg.eigvalsh(step.covariance)[0] > 0.0 for step in kept.results)


def test_the_pose_between_scans_is_as_uncertain_as_a_short_drive(room):
    """What is shown while no scan arrives, from the newest one on: 0.1 s, or 5 cm at 0.5 m/s."""
    run = Run(load("default", ["odometry.kind=lidar_only", MOUNT]))
    feed(run, [m for m in room if isinstance(m, LaserScan)][:20])
    rows = run.dead_reckoned()
    assert np.sqrt(np.diag(rows.covariances[0])[:2]).max() < 0.15
    assert run.robot.ahead().covariance[0, 0] == pytest.approx(0.05**2, rel=0.01)


def test_a_jump_of_the_scans_is_not_blamed_on_odometry(room, tmp_path):
    """The scans of 1.5 s are missing, and the later ones are stamped as if no time had passed."""
    at, seconds = room[0].stamp + 5.0, 1.5
    scans = [m for m in room if isinstance(m, LaserScan)]
    later = [replace(m, stamp=m.stamp - seconds) for m in scans if m.stamp >= at + seconds]
    messages = [m for m in scans if m.stamp < at] + later
    matching = "tracker.kind=scan_to_map", "estimator.kind=graph"
    outcome = mapped(messages, tmp_path, *matching).outcome
    assert set(outcome.health.reasons) == {NONE, JUMPED}
    assert set(outcome.dropped) == {"motion jumps"}
    said = outcome.dropped["motion jumps"].example, *(s.description for s in outcome.health.spans())
    assert not any("odometry" in text or "wheels" in text for text in said)


# --------------------------------------------------------------------------- without being asked


def test_a_log_without_odometry_ends_in_one_line_that_names_lidar_only(room, tmp_path):
    messages = [m for m in room if isinstance(m, (LaserScan, TruePose))]
    with pytest.raises(SourceError, match="lidar_only") as error:
        map_log(load("default", [MOUNT]), Played.of(messages, tmp_path))
    assert "\n" not in str(error.value)
    assert "no OdometryPose" in str(error.value)
