"""A whole run: order, stamps, truth, and the same to the byte for the same seed."""

import itertools
import math

import numpy as np
import pytest

from impslam.simulation.drive import drive
from impslam.simulation.robot import InertialUnit, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate, sweep_times, ticks
from impslam.simulation.world import load_world
from impslam.types import Imu, LaserScan, TruePose, WheelAngles

ROOM = load_world("room")


def of(kind, messages):
    return [message for message in messages if isinstance(message, kind)]


def content(message) -> bytes:
    values = [getattr(message, name) for name in type(message).__slots__]
    return type(message).__name__.encode() + b"".join(
        np.asarray(value, float).tobytes() for value in values if value is not None
    )


def arrival(message) -> float:
    late = message.time_offsets[-1] if isinstance(message, LaserScan) else 0.0
    return float(message.stamp + late)


def test_same_seed_same_bytes_and_another_seed_others():
    one, same, other = (b"".join(map(content, simulate(ROOM, seed=s))) for s in (7, 7, 8))
    assert one == same
    assert one != other


def test_messages_arrive_in_order_and_scans_after_their_sweep():
    messages = list(simulate(ROOM))
    times = np.array([arrival(message) for message in messages])
    assert (np.diff(times) >= 0.0).all()
    first = next(i for i, m in enumerate(messages) if isinstance(m, LaserScan))
    assert messages[first].stamp == 1000.0
    assert sum(isinstance(m, WheelAngles) for m in messages[:first]) == 7


def test_rates_and_stamps():
    messages = list(simulate(ROOM))
    seconds = drive(ROOM.robot).duration
    for kind, rate in ((WheelAngles, 100), (Imu, 100), (LaserScan, 10)):
        stamps = np.array([message.stamp for message in of(kind, messages)])
        np.testing.assert_allclose(np.diff(stamps), 1.0 / rate, atol=1e-9)
        assert len(stamps) == pytest.approx(seconds * rate, abs=2)


def test_truth_is_given_at_every_scan_and_encoder_stamp():
    messages = list(simulate(ROOM))
    truth = {message.stamp: message.pose for message in of(TruePose, messages)}
    assert {m.stamp for m in messages} == set(truth)
    way = drive(ROOM.robot)
    stamps = np.array(sorted(truth))
    np.testing.assert_allclose(
        np.array([truth[stamp] for stamp in stamps]), way.at(stamps - 1000.0), atol=1e-9
    )


def test_truth_is_given_at_scan_stamps_off_the_grid():
    robot = SimulatedRobot()
    robot = robot.model_copy(update={"lidar": robot.lidar.model_copy(update={"rate": 7.0})})
    messages = list(simulate(ROOM, robot))
    scans = {message.stamp for message in of(LaserScan, messages)}
    assert scans <= {message.stamp for message in of(TruePose, messages)}


def test_equal_times_at_different_rates_are_equal_numbers():
    assert set(ticks(10.0, 500.0)) <= set(ticks(100.0, 500.0))


def test_truth_does_not_depend_on_the_seed():
    one, other = (of(TruePose, simulate(ROOM, seed=s)) for s in (1, 2))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)


def test_switching_one_device_off_leaves_the_others_as_they_were():
    everything = list(simulate(ROOM, SimulatedRobot(), 3))
    for update, kinds in (
        ({"lidar": None}, (WheelAngles, Imu)),
        ({"encoders": WheelEncoders.perfect()}, (LaserScan, Imu)),
        ({"imu": InertialUnit.perfect()}, (LaserScan, WheelAngles)),
    ):
        without = list(simulate(ROOM, SimulatedRobot(**update), 3))
        for kind in kinds:
            a, b = (b"".join(map(content, of(kind, run))) for run in (everything, without))
            assert a == b


@pytest.mark.parametrize("fault", ["radius_sigma", "slip_sigma", "skid_rate", "noise"])
def test_switching_one_fault_off_leaves_the_draws_of_the_others(fault):
    """With a fault at next to nothing the reading is that without it: no other draw has moved."""

    def last(size: float) -> float:
        encoders = WheelEncoders(counts=0, skid_length=1e-9).model_copy(update={fault: size})
        robot = SimulatedRobot(encoders=encoders, lidar=None, imu=None)
        return of(WheelAngles, simulate(ROOM, robot, 5))[-1].left

    assert last(0.0) == pytest.approx(last(1e-14 if fault != "skid_rate" else 2.0), abs=1e-4)


def test_run_is_lazy():
    head = list(itertools.islice(simulate(load_world("corridor")), 5))
    assert len(head) == 5


def test_scans_are_counted_before_they_are_made():
    robot = SimulatedRobot()
    way = drive(ROOM.robot)
    assert len(sweep_times(robot, way)) == len(of(LaserScan, simulate(ROOM, robot)))


def dead_reckoning_error(world, seed: int) -> float:
    robot = SimulatedRobot(lidar=None, imu=None)
    messages = list(simulate(world, robot, seed))
    angles = np.array([[m.left, m.right] for m in of(WheelAngles, messages)])
    left, right = np.diff(angles, axis=0).T * robot.encoders.wheel_radius
    turn = (right - left) / robot.encoders.track
    middle = world.robot.start[2] + np.cumsum(turn) - 0.5 * turn
    steps = 0.5 * (left + right) * np.array([np.cos(middle), np.sin(middle)])
    return math.dist(steps.sum(axis=1) + world.robot.start[:2], of(TruePose, messages)[-1].pose[:2])


def test_dead_reckoning_of_the_default_robot_drifts_moderately():
    errors = [dead_reckoning_error(load_world("arena"), seed) for seed in range(12)]
    assert 0.25 < np.median(errors) < 1.0
    assert max(errors) < 2.5
