"""Calibration from logs to a config: parameters of a simulated robot, observability, written tables."""

from dataclasses import replace

import numpy as np
import pytest

from impslam.calibration.calibrate import calibrate, config_tables, extract_drives
from impslam.calibration.gyro import calibrate_gyro
from impslam.calibration.lidar_path import lidar_path
from impslam.calibration.recording import record_batches
from impslam.calibration.scan_pairs import match_pairs
from impslam.columns import batches
from impslam.component import build
from impslam.config import load, merge
from impslam.errors import ConfigError, SourceError
from impslam.simulation.robot import InertialUnit, Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world

WRONG = load(
    "imp",
    [
        "odometry.track=0.44",
        "odometry.wheel_radius=0.062",
        "sensors.lidar.mount=[0.1,0.03,0.1]",
        "sensors.lidar.latency=0.1",
    ],
)
EIGHT = [(0.9, 0.3), (1.5, 0.9), (0.9, 1.3), (0.3, 0.9), (0.9, 0.4), (0.3, -0.3), (-0.2, 0.3)]


def recorded(waypoints, robot, rounds=1, world="room"):
    """Return the recording of a robot that drives along waypoints in a world."""
    world = load_world(world)
    route = {"waypoints": tuple(waypoints) * rounds, "lookahead": 0.2}
    driver = world.robot.model_copy(update=route)
    messages = simulate(world.model_copy(update={"robot": driver, "cylinders": ()}), robot)
    return record_batches(WRONG, batches((type(m).__name__, m) for m in messages))


@pytest.fixture(scope="module")
def eight():
    """A figure of eight by a robot with fine wheels, another track and mount, and a biased gyro."""
    robot = SimulatedRobot(
        encoders=WheelEncoders.perfect(track=0.41, wheel_radius=0.064, noise=1e-6),
        lidar=Lidar.perfect(mount=(0.12, -0.02, 0.05), sigma=0.003),
        imu=InertialUnit(gyro_bias_sigma=0.02, gyro_sigma=0.004),
    )
    return recorded(EIGHT, robot, rounds=2)


def test_parameters_of_the_robot(eight):
    found = calibrate(WRONG, extract_drives(WRONG, eight, "log"))
    got = {one.name: one for one in found.parameters}
    true = {
        "wheel_radius": 0.064,
        "track": 0.41,
        "x": 0.12,
        "y": -0.02,
        "yaw": 0.05,
        "latency": 0.0,
    }
    for name, value in true.items():
        assert got[name].observable
        assert abs(got[name].value - value) < max(4.0 * got[name].sigma, 1e-3 * abs(value))
        assert got[name].sigma < 0.01
    assert not got["range_scale"].observable
    config = load(merge(WRONG.model_dump(exclude_none=True), config_tables(found)))
    assert config.odometry["track"] == got["track"].value
    assert config.sensors["lidar"]["mount"] == [got[name].value for name in ("x", "y", "yaw")]


def test_range_scale_follows_from_a_kept_length(eight):
    """The configured track is 0.44 m, the true one 0.41: all lengths are 7.3 % larger, ranges too."""
    config = load(WRONG.model_dump(exclude_none=True), ["sensors.lidar.latency=0"])
    got = {
        one.name: one
        for one in calibrate(config, extract_drives(config, eight, "log"), ["track"]).parameters
    }
    assert not got["track"].observable
    assert got["range_scale"].value == pytest.approx(0.44 / 0.41, rel=0.02)
    assert got["wheel_radius"].value == pytest.approx(0.064 * 0.44 / 0.41, rel=0.02)


def test_calibrated_turns_have_no_systematic_error_left(eight):
    """But a track that was kept may be wrong, so the noise that was found includes its error."""
    drives = extract_drives(WRONG, eight, "log")
    own = build("odometry", WRONG.odometry).slip.systematic
    assert own > 0.0
    for keep, share in (((), 0.0), (("track",), own)):
        tables = config_tables(calibrate(WRONG, drives, keep))
        config = load(merge(WRONG.model_dump(exclude_none=True), tables))
        assert build("odometry", config.odometry).slip.systematic == share


def test_several_logs_reduce_the_sigmas(eight):
    drives = extract_drives(WRONG, eight, "log")
    one, two = calibrate(WRONG, drives), calibrate(WRONG, [*drives, *drives])
    ratio = {
        a.name: a.sigma / b.sigma
        for a, b in zip(one.parameters, two.parameters, strict=True)
        if a.observable
    }
    assert ratio.pop("range_offset") < 1.2  # a systematic error, common to all drives
    np.testing.assert_allclose(list(ratio.values()), np.sqrt(2.0), rtol=0.15)


def test_track_is_not_observable_from_straight_driving():
    robot = SimulatedRobot(
        encoders=WheelEncoders.perfect(), lidar=Lidar.perfect(sigma=0.003), imu=None
    )
    drives = extract_drives(WRONG, recorded([(0.0, 1.2), (0.0, 4.9)], robot, world="arena"), "log")
    got = {one.name: one for one in calibrate(WRONG, drives).parameters}
    assert got["wheel_radius"].observable
    for name, before in (("track", 0.44), ("x", 0.1), ("y", 0.03)):
        assert not got[name].observable
        assert got[name].value == before


def test_the_gyro(eight):
    _, lidar = "lidar", WRONG.make_robot().sensors["lidar"]
    motions = match_pairs(lidar, eight.scans, lidar_path(lidar, eight.scans))
    found = calibrate_gyro(eight.gyro, motions, 0.0)
    standing = eight.gyro[eight.gyro[:, 0] < eight.gyro[0, 0] + 0.9, 1]
    assert abs(found.bias - standing.mean()) < 4.0 * np.hypot(
        found.bias_sigma, standing.std() / 9.0
    )
    assert abs(found.scale - 1.0) < 4.0 * found.scale_sigma
    assert calibrate_gyro(np.empty((0, 2)), motions, 0.0) is None
    turned = calibrate_gyro(eight.gyro * [1.0, -1.0], motions, 0.0)
    assert turned.scale == pytest.approx(-found.scale)
    assert turned.bias_sigma == pytest.approx(found.bias_sigma)


@pytest.mark.parametrize("rate", [0.0, 0.1])
def test_a_gyro_whose_rate_never_changes_is_not_calibrated(eight, rate):
    _, lidar = "lidar", WRONG.make_robot().sensors["lidar"]
    motions = match_pairs(lidar, eight.scans, lidar_path(lidar, eight.scans))
    readings = np.column_stack((eight.gyro[:, 0], np.full(len(eight.gyro), rate)))
    assert calibrate_gyro(readings, motions, 0.0) is None


def test_errors_for_logs_that_cannot_be_calibrated(eight):
    with pytest.raises(
        ConfigError, match="--keep radius: no such parameter; there are wheel_radius"
    ):
        calibrate(WRONG, extract_drives(WRONG, eight, "log"), ["radius"])
    with pytest.raises(SourceError, match="log: has no OdometryPose to calibrate"):
        extract_drives(load("default"), replace(eight, odometry=()), "log")
    alone = load("default", ["odometry.kind=lidar_only"])
    with pytest.raises(SourceError, match="log: has no odometry to calibrate; record odometry"):
        extract_drives(alone, eight, "log")
    robot = SimulatedRobot(imu=None)
    with pytest.raises(SourceError, match="motions of the lidar were matched, and 10 are needed"):
        extract_drives(WRONG, recorded([(0.3, 0.0)], robot), "log")
