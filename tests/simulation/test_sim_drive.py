"""Driving: limits kept, end reached, and motion known exactly between the knots."""

import math

import numpy as np
import pytest

from impslam.errors import ConfigError
from impslam.simulation.drive import CONTROL_RATE, advance, drive
from impslam.simulation.world import Drive, load_world


@pytest.mark.parametrize("name", ["arena", "room", "corridor"])
def test_robot_keeps_its_limits_and_reaches_the_end_of_its_path(name):
    plan = load_world(name).robot
    way = drive(plan)
    v, omega = way.twists.T
    assert v.min() >= 0.0
    assert v.max() <= plan.speed + 1e-12
    assert np.abs(omega).max() <= plan.turn_rate + 1e-12
    assert np.abs(np.diff(v)).max() * CONTROL_RATE <= plan.acceleration + 1e-9
    assert np.abs(np.diff(omega)).max() * CONTROL_RATE <= plan.turn_acceleration + 1e-9
    assert (way.twists[0] == 0).all()
    assert (way.twists[-1] == 0).all()
    assert math.dist(way.poses[-1, :2], plan.waypoints[-1]) < 1e-3
    np.testing.assert_array_equal(way.poses[0], plan.start)


def test_arena_run_has_the_documented_duration_and_end():
    way = drive(load_world("arena").robot)
    assert 60.0 <= way.duration <= 120.0
    np.testing.assert_allclose(way.poses[-1, :2], [-0.4459, 2.3715], atol=2e-4)


def test_poses_between_knots_lie_on_the_same_arc():
    way = drive(load_world("room").robot)
    np.testing.assert_allclose(way.at(way.times), way.poses, atol=1e-12)
    for i in (150, 400, 700):
        since = 0.3 / CONTROL_RATE
        arc = advance(way.poses[i], tuple(way.twists[i]), since)
        np.testing.assert_allclose(way.at(way.times[i : i + 1] + since)[0], arc, atol=1e-12)


def test_travel_is_the_integral_of_the_twists():
    way = drive(load_world("room").robot)
    driven, turned = way.travel(way.times)
    np.testing.assert_allclose(driven[-1], way.twists[:, 0].sum() / CONTROL_RATE)
    unwrapped = np.unwrap(way.poses[:, 2])
    np.testing.assert_allclose(turned, unwrapped - unwrapped[0], atol=1e-9)


def test_robot_turns_on_the_spot_towards_a_goal_behind_it():
    way = drive(Drive(waypoints=((-1.0, 0.0),)))
    turning = np.flatnonzero(np.abs(way.twists[:, 1]) > 0.1)
    assert np.hypot(*way.poses[turning[len(turning) // 2], :2]) < 0.02
    np.testing.assert_allclose(way.poses[-1, :2], [-1.0, 0.0], atol=1e-3)


def test_limit_ends_the_run():
    assert drive(Drive(waypoints=((9.0, 0.0),), limit=2.5)).duration == 2.5


def test_robot_that_circles_its_goal_is_an_error_not_a_hang():
    plan = Drive(
        waypoints=((2.0, 0.0), (2.0, 0.3), (0.0, 0.3)),
        speed=2.0,
        lookahead=0.01,
        turn_rate=0.5,
        turn_acceleration=0.05,
    )
    with pytest.raises(ConfigError, match="increase lookahead"):
        drive(plan)
