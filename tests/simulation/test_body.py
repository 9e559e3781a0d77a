"""The body: exact arcs without faults, the offline statistics with them, and nothing it passes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp

from impslam.errors import ConfigError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, exp
from impslam.simulation.body import MEMORY, STEP, Body
from impslam.simulation.body_lidar import LidarSweeps
from impslam.simulation.body_motion import Drivetrain, clearance
from impslam.simulation.drive import Trajectory
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.noise import wheel_angles
from impslam.simulation.robot import InertialUnit, Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.scene import Scene
from impslam.simulation.simulate import ticks
from impslam.simulation.world import Door, Wall, World, load_world

PERFECT = SimulatedRobot.perfect()
AT_ONCE = Drivetrain(time_constant=0.0, acceleration=1e6)


def world(radius: float = 0.25, **parts: object) -> World:
    robot = {"start": (0, 0, 0), "waypoints": [(1, 0)], "radius": radius}
    return World.model_validate({"robot": robot, **parts})


EMPTY = world()
ARENA = load_world("arena")


def body(place: World = EMPTY, **faults: object) -> Body:
    return Body(place, PERFECT, drivetrain=AT_ONCE, **faults)


def put(robot: Body, x: float, y: float, heading: float) -> Body:
    robot._state[:3] = x, y, heading
    robot._history[:] = robot._state
    return robot


def test_a_carried_robot_stands_elsewhere_and_its_wheels_and_gyro_notice_nothing():
    robot = Body(ARENA, PERFECT, drivetrain=AT_ONCE)
    robot.drive(0.3, 0.3)
    robot.advance(1.0)
    wheels, start = robot.wheel_angles(), robot.pose
    robot.put_down(4.0, 1.0)
    np.testing.assert_array_equal(robot.pose, [4.0, 1.0, start[2]])
    assert robot.wheel_angles() == wheels
    robot.drive(0.0, 0.0)
    robot.advance(1.1)
    np.testing.assert_allclose(robot.pose, [4.0, 1.0, start[2]], atol=1e-3)
    np.testing.assert_allclose(robot.inertial()[0], 0.0)


def test_a_robot_is_not_put_down_on_an_obstacle():
    robot = Body(ARENA, PERFECT)
    before = robot.pose
    with pytest.raises(ConfigError, match="an obstacle is"):
        robot.put_down(*ARENA.cylinders[0].centre)
    np.testing.assert_array_equal(robot.pose, before)


# ---------------------------------------------------------------------------------- motion


@pytest.mark.parametrize(("left", "right"), [(0.3, 0.3), (0.2, 0.5), (-0.4, 0.4), (-0.1, -0.6)])
def test_settled_motion_is_an_exact_arc(left, right):
    robot = body()
    robot.drive(left, right)
    robot.advance(2.0)
    turn_rate = AT_ONCE.turn_efficiency * (right - left) / AT_ONCE.track
    twist = np.array([0.5 * (left + right), 0.0, turn_rate])
    np.testing.assert_allclose(robot.twist, twist[[0, 2]], atol=1e-12)
    start = robot.at(np.array([0.5]))[0]
    for time in (0.8, 1.2345, 2.0):
        expected = compose(start, exp(twist * (time - 0.5)))
        found = robot.at(np.array([time]))[0]
        # Between two steps the way is taken as straight: omega v STEP^2 / 8.
        np.testing.assert_allclose(found[:2], expected[:2], atol=1e-7)
        assert abs(wrap(found[2] - expected[2])) < 1e-9
    np.testing.assert_allclose(robot.pose, robot.at(np.array([2.0]))[0])


def test_motors_follow_with_a_first_order_lag():
    train = Drivetrain(acceleration=100.0)
    robot = Body(EMPTY, PERFECT, drivetrain=train)
    robot.drive(0.2, 0.5)
    robot.advance(0.3)
    grown = 1.0 - math.exp(-0.3 / train.time_constant)
    np.testing.assert_allclose(robot.motors, [0.2 * grown, 0.5 * grown])
    # Both sides grow alike, so that the way is one arc of known length.
    driven = 0.3 - train.time_constant * grown
    turn_rate = 0.3 / train.effective_track
    np.testing.assert_allclose(robot.pose, exp(np.array([0.35, 0, turn_rate]) * driven), atol=1e-6)


def test_motors_are_limited_in_acceleration_and_speed():
    robot = Body(EMPTY, PERFECT)
    robot.drive(5.0, 5.0)
    np.testing.assert_allclose(robot.commanded, [1.0, 1.0])
    robot.advance(0.05)
    np.testing.assert_allclose(robot.motors, [0.25, 0.25])
    robot.advance(3.0)
    np.testing.assert_allclose(robot.motors, [1.0, 1.0], atol=1e-6)


def test_turn_efficiency_balances_the_friction_of_four_wheels():
    train = Drivetrain()
    w, omega = 0.3, train.turn_efficiency * 2 * 0.3 / train.track
    moment = 0.0
    for x in (0.5 * train.wheelbase, -0.5 * train.wheelbase):
        for y in (0.5 * train.track, -0.5 * train.track):
            surface = np.array([w if y < 0 else -w, 0.0])
            sliding = omega * np.array([-y, x]) - surface
            force = -sliding / np.linalg.norm(sliding)
            moment += x * force[1] - y * force[0]
    assert moment == pytest.approx(0.0, abs=1e-12)
    assert train.turn_efficiency == pytest.approx(0.64)


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_robot_turns_about_a_stalled_side(side, sign):
    robot = Body(EMPTY, PERFECT)
    robot.drive(0.3, 0.3)
    robot.advance(1.0)
    robot.stall(side, True)
    assert robot.stalled == (side == "left", side == "right")
    robot.advance(3.0)
    assert robot.motors[("left", "right").index(side)] == pytest.approx(0.0, abs=1e-6)
    assert robot.twist[1] == pytest.approx(sign * 0.3 / Drivetrain().effective_track, abs=1e-6)
    robot.stall(side, False)
    assert robot.stalled == (False, False)
    robot.advance(5.0)
    np.testing.assert_allclose(robot.twist, [0.3, 0.0], atol=1e-6)


def test_the_same_commands_give_the_same_run_in_any_steps():
    runs = []
    for size in (0.001, 0.0137, 0.7):
        robot = Body(ARENA, seed=3)
        for begin, told in ((0.0, (0.3, 0.2)), (1.0, (-0.2, 0.3)), (2.0, (0.0, 0.0))):
            robot.drive(*told)
            for time in np.append(np.arange(begin, begin + 1.0, size), begin + 1.0):
                robot.advance(time)
        runs.append([*robot.pose, *robot.wheel_angles(), robot.time])
    np.testing.assert_array_equal(runs[1], runs[0])
    np.testing.assert_array_equal(runs[2], runs[0])


def test_time_does_not_run_backwards_and_memory_ends():
    robot = body()
    robot.drive(0.5, 0.5)
    robot.advance(1.0)
    robot.advance(0.5)
    assert robot.time == 1.0
    robot.advance(10.0)
    oldest = 10.0 - MEMORY + STEP
    x = robot.at(np.array([0.0, oldest, 9.0, 11.0]))[:, 0]
    np.testing.assert_allclose(np.diff(x), 0.5 * np.diff([oldest, oldest, 9.0, 10.0]), atol=1e-9)


@pytest.mark.parametrize("speed", [math.nan, math.inf])
def test_non_finite_speeds_are_rejected(speed):
    with pytest.raises(ValueError, match="not finite"):
        body().drive(0.1, speed)


def test_a_robot_too_small_to_stop_is_rejected():
    with pytest.raises(ConfigError, match=r"robot\.radius = 0\.001 m: too small"):
        body(world(radius=0.001))


# ---------------------------------------------------------------------------------- contact


def gap(robot: Body) -> float:
    return robot.scene.clearance(robot.pose[:2], robot.time)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-math.pi, math.pi),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=6),
)
def test_nothing_in_the_arena_is_ever_entered(heading, commands):
    robot = put(body(ARENA), -0.3, 1.5, heading)
    end = 0.0
    for told in commands:
        robot.drive(*told)
        for _ in range(10):
            end += 0.1
            robot.advance(end)
            assert gap(robot) >= 0.25 - 1e-9
            assert -1.6764 < robot.pose[0] < 0.3048
            assert -0.3048 < robot.pose[1] < 6.0960


OBSTACLES = {
    "cylinder": {"cylinders": [{"centre": (0, 0), "radius": 0.15}]},
    "box": {"boxes": [{"centre": (0, 0), "size": (0.4, 0.2), "angle": 0.3}]},
    "wall": {"walls": [{"start": (-0.3, 0.1), "end": (0.3, -0.1)}]},
    "corner": {
        "walls": [{"start": (-1, 0), "end": (0, 0)}, {"start": (0, 0), "end": (0.3, 1)}],
    },
}


@settings(max_examples=25, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-0.4, 0.4), st.sampled_from([1.0, -1.0]))
@pytest.mark.parametrize("kind", OBSTACLES)
def test_obstacles_stop_the_robot_from_all_sides(kind, side, aim, gear):
    """It drives at the obstacle, forwards or backwards, 2 m through the place where that is."""
    robot = body(world(**OBSTACLES[kind]))
    heading = side + math.pi + aim + (0.0 if gear > 0 else math.pi)
    put(robot, 1.0 * math.cos(side), 1.0 * math.sin(side), heading)
    before = gap(robot)
    robot.drive(gear, gear)
    for time in np.arange(1, 41) * 0.05:
        robot.advance(time)
        assert gap(robot) >= min(0.25, before) - 1e-9


@pytest.mark.parametrize("speed", [1.0, -1.0])
def test_it_stops_at_a_wall_and_its_wheels_stop(speed):
    walls = [{"start": (x, -2), "end": (x, 2)} for x in (-1.0, 1.0)]
    robot = body(world(walls=walls))
    robot.drive(speed, speed)
    robot.advance(2.0)
    np.testing.assert_allclose(robot.pose, [0.75 * speed, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(robot.twist, 0.0, atol=1e-6)
    np.testing.assert_allclose(robot.motors, speed)
    radius = PERFECT.encoders.wheel_radius
    np.testing.assert_allclose(robot.wheel_angles(), 0.75 * speed / radius, atol=1e-4)
    robot.drive(-speed, -speed)
    robot.advance(2.5)
    np.testing.assert_allclose(robot.pose[0], 0.25 * speed, atol=2e-3)


def test_it_slides_along_a_wall_with_the_remaining_speed():
    robot = put(body(world(walls=[{"start": (-1, 0.25), "end": (20, 0.25)}])), 0, 0, 0.5)
    robot.drive(0.4, 0.4)
    robot.advance(5.0)
    along = 0.4 * math.cos(0.5) * 5.0
    np.testing.assert_allclose(robot.pose, [along, 0.0, 0.5], atol=3e-4)  # the first step's start
    # Wheels roll along their own direction only.
    assert robot.twist[0] == pytest.approx(0.4 * math.cos(0.5) ** 2, abs=1e-6)


def test_it_can_turn_in_contact():
    robot = put(body(world(walls=[{"start": (-1, 0.25), "end": (1, 0.25)}])), 0, 0, 0)
    robot.drive(-0.3, 0.3)
    robot.advance(1.0)
    assert robot.pose[2] == pytest.approx(AT_ONCE.turn_efficiency * 0.6 / 0.4, abs=2e-3)
    np.testing.assert_allclose(robot.pose[:2], 0.0, atol=1e-6)


def test_a_robot_put_too_near_can_leave_but_come_no_nearer():
    near = world(walls=[{"start": (0.1, -2), "end": (0.1, 2)}])
    robot = body(near)
    robot.drive(0.5, 0.5)
    robot.advance(0.5)
    np.testing.assert_allclose(robot.pose[0], 0.0, atol=1e-6)
    robot.drive(-0.5, -0.5)
    robot.advance(1.0)
    np.testing.assert_allclose(robot.pose[0], -0.25, atol=2e-3)


def test_open_doors_can_be_passed():
    wall = Wall(name="w", start=(1.0, -3.0), end=(1.0, 3.0))
    door = Door(wall="w", at=2.5, width=1.0, open=((3.0, 9.0),), swing_time=0.5)
    place = world(walls=[wall.model_dump()], doors=[door.model_dump()])
    robot = body(place)
    robot.drive(0.5, 0.5)
    robot.advance(2.9)
    assert robot.pose[0] == pytest.approx(1.07 - 0.25, abs=1e-6)
    robot.advance(8.0)
    assert robot.pose[0] > 2.0


def test_clearance_agrees_with_that_of_the_scene():
    scene = Scene(ARENA)
    rng = np.random.default_rng(5)
    for x, y in rng.uniform([-1.6, -0.2], [0.2, 6.0], (50, 2)):
        distance, nx, ny = clearance(x, y, (scene.segments, scene.circles))
        assert math.hypot(nx, ny) == pytest.approx(1.0)
        expected = scene.clearance(np.array([x, y]), 0.0)
        assert distance == pytest.approx(expected, abs=1e-12)


# ---------------------------------------------------------------------------------- wheels


LEGS = [((0.5, 0.5), 2.0), ((-0.2, 0.2), 1.5), ((0.4, 0.3), 1.0), ((0.3, -0.1), 1.5)]


def drive_legs(robot: Body) -> Body:
    end = 0.0
    for told, duration in LEGS:
        robot.drive(*told)
        end += duration
        robot.advance(end)
    return robot


def legs_trajectory() -> Trajectory:
    """The same way, as the offline simulation has it."""
    twists = np.repeat(
        [
            [0.5 * (left + right), (right - left) / AT_ONCE.effective_track]
            for (left, right), _ in LEGS
        ],
        [round(100 * duration) for _, duration in LEGS],
        axis=0,
    )
    poses = [np.zeros(3)]
    for v, omega in twists:
        poses.append(compose(poses[-1], exp(np.array([v, 0.0, omega]) * 0.01)))
    return Trajectory(np.arange(len(twists) + 1) / 100, np.array(poses), twists)


def test_perfect_wheels_integrate_to_the_true_path():
    robot = Body(ARENA, PERFECT, drivetrain=Drivetrain())
    put(robot, -0.5, 1.0, 1.0)
    pose, last, time = robot.pose, np.zeros(2), 0.0
    encoders = PERFECT.encoders
    for told, _ in LEGS:
        robot.drive(*told)
        for _ in range(50):
            time += 0.01
            robot.advance(time)
            angles = np.array(robot.wheel_angles())
            left, right = encoders.wheel_radius * (angles - last)
            last = angles
            turn = (right - left) / encoders.track
            pose = compose(pose, exp(np.array([0.5 * (left + right), 0.0, turn])))
    np.testing.assert_allclose(pose, robot.pose, atol=1e-5)


FAULTS = {
    "radii": {"radius_sigma": 0.01},
    "track": {"track_sigma": 0.05},
    "ground": {"noise": 4e-4},
    "slip": {"slip_sigma": 0.1},
    "skids": {"skid_rate": 1.0, "skid_length": 0.02},
}


def online(number: int, **faults: float) -> np.ndarray:
    robot = SimulatedRobot(encoders=WheelEncoders.perfect(**faults))
    return np.array(
        [drive_legs(Body(EMPTY, robot, s, AT_ONCE)).wheel_angles() for s in range(number)]
    )


def offline(number: int, **faults: float) -> np.ndarray:
    encoders, way = WheelEncoders.perfect(**faults), legs_trajectory()
    times = ticks(encoders.rate, way.duration)
    runs = [
        wheel_angles(encoders, way, times, np.random.default_rng([1, s]))[-1] for s in range(number)
    ]
    return np.array(runs)


@pytest.mark.parametrize("kind", FAULTS)
def test_wheels_have_the_statistics_of_the_offline_simulation(kind):
    """Sum and difference of the angles tell faults of a side, of both, and of rotation apart."""
    # Less what it would be without, which a step's change of speed makes differ by 0.0002 rad.
    ours = np.round(online(400, **FAULTS[kind]) - online(1), 6)
    theirs = np.round(offline(400, **FAULTS[kind]) - offline(1), 6)
    for combine in ([1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [-1.0, 1.0]):
        a, b = ours @ combine, theirs @ combine
        if min(np.std(a), np.std(b)) < 1e-3:  # the fault does not show here: both are exact
            np.testing.assert_allclose(a.mean(), b.mean(), atol=0.02)
            continue
        assert ks_2samp(a, b).pvalue > 1e-3
        # The share of the noise in it, which the first test would miss at equal means.
        assert np.std(a) / np.std(b) == pytest.approx(1.0, abs=0.2)


def test_the_comparison_detects_50_percent_more_noise():
    a = online(400, slip_sigma=0.15) @ [-1.0, 1.0]
    b = offline(400, slip_sigma=0.1) @ [-1.0, 1.0]
    assert ks_2samp(a, b).pvalue < 1e-3


def test_switching_one_fault_off_leaves_the_others():
    both = online(20, noise=4e-4, slip_sigma=0.1)
    one = online(20, noise=4e-4)
    other = online(20, slip_sigma=0.1)
    exact = online(1)
    np.testing.assert_allclose(both - exact, (one - exact) + (other - exact), atol=0.1)


def test_readings_are_multiples_of_the_encoders_step_and_silent_at_rest():
    robot = Body(EMPTY, SimulatedRobot(encoders=WheelEncoders(noise=1.0)), 2)
    robot.advance(1.0)
    first = robot.wheel_angles()
    robot.advance(2.0)
    assert robot.wheel_angles() == first
    drive_legs(robot)
    steps = np.array(robot.wheel_angles()) * 4096 / (2 * math.pi)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


# ---------------------------------------------------------------------------------- inertia


def test_perfect_gyro_sums_to_the_angle_and_accelerometer_to_the_speed():
    robot = Body(EMPTY, PERFECT)
    robot.drive(0.2, 0.5)
    turned = gained = 0.0
    for k in range(1, 101):
        robot.advance(k / 100)
        rates, forces = robot.inertial()
        turned += rates[2] / 100
        gained += forces[0] / 100
    assert turned == pytest.approx(robot.heading())
    assert gained == pytest.approx(robot.twist[0])
    v, omega = robot.twist
    np.testing.assert_allclose(forces, [0.0, v * omega, 9.80665], atol=1e-3)


def test_gyro_noise_and_bias():
    unit = InertialUnit.perfect(gyro_sigma=0.01, gyro_bias_sigma=0.1)
    robots = [Body(EMPTY, SimulatedRobot(imu=unit), s) for s in range(100)]
    runs = np.array([[robot.inertial()[0] for _ in range(200)] for robot in robots])
    assert np.mean(runs.std(axis=1)) == pytest.approx(0.01, rel=0.02)
    assert np.std(runs.mean(axis=1)) == pytest.approx(0.1, rel=0.15)


def test_missing_devices_read_without_faults():
    robot = Body(EMPTY, SimulatedRobot(encoders=None, imu=None), 1)
    np.testing.assert_array_equal(robot.wheel_angles(), [0.0, 0.0])
    np.testing.assert_array_equal(robot.inertial()[1], [0.0, 0.0, 9.80665])


# ---------------------------------------------------------------------------------- lidar


def test_sweeps_see_the_arena_from_where_the_body_was():
    robot = put(Body(ARENA, PERFECT, drivetrain=AT_ONCE), -0.3, 1.0, 1.0)
    robot.drive(0.2, 0.3)
    robot.advance(1.0)
    found = LidarSweeps(robot).ranges(0.5)
    pose = robot.at(np.array([0.5]))[0]
    twist = np.array([0.25, 0.1 / AT_ONCE.effective_track])
    times = np.arange(101) / 100
    poses = [compose(pose, exp(np.array([twist[0], 0.0, twist[1]]) * t)) for t in times]
    way = Trajectory(times, np.array(poses), np.tile(twist, (100, 1)))
    rng = np.random.default_rng(0)
    expected = LidarSimulator(Lidar.perfect(), Scene(ARENA), way, rng).ranges(0.0)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert (found > 0).mean() > 0.9


@pytest.mark.parametrize("begin", [4.97, 0.5])
def test_a_sweep_outside_the_stored_past_is_rejected(begin):
    robot = body(ARENA)
    robot.advance(5.0)
    with pytest.raises(ValueError, match="cannot be read"):
        LidarSweeps(robot).ranges(begin)
