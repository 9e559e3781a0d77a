"""The thesis's gates: 2 m between points, feet and angles between walls."""

import math

import numpy as np
import pytest
from tests.association.scenes import mapped, pairs, point, wall

from impslam.association.nearest import Nearest

ORIGIN = np.zeros(3)


@pytest.mark.parametrize(("apart", "matched"), [(1.99, True), (2.01, False)])
def test_points_within_two_metres_match(apart, matched):
    belief = mapped([point(ORIGIN, (3, 0))])
    choice = belief.associate((point(ORIGIN, (3 + apart, 0)),), Nearest())
    assert (len(choice.matches), len(choice.new)) == ((1, 0) if matched else (0, 1))


def test_the_nearer_of_two_observations_has_the_landmark():
    """The other is too near to be new."""
    belief = mapped([point(ORIGIN, (3, 0))])
    choice = belief.associate((point(ORIGIN, (4, 0)), point(ORIGIN, (3.5, 0))), Nearest())
    assert pairs(choice) == {1: 0}
    assert choice.new == ()


def test_perpendicular_walls_near_the_origin_stay_two():
    """Their feet are 0.14 m apart; only the angle tells them from one another."""
    ahead, aside = [[0.1, -1], [0.1, 1]], [[-1, 0.1], [1, 0.1]]
    belief = mapped([wall(ORIGIN, ahead)])
    choice = belief.associate((wall(ORIGIN, aside),), Nearest())
    assert choice.new == (0,)
    assert pairs(belief.associate((wall(ORIGIN, ahead),), Nearest())) == {0: 0}


@pytest.mark.parametrize(("degrees", "matched"), [(29.0, True), (31.0, False)])
def test_walls_match_up_to_the_angle_between_them(degrees, matched):
    t = math.radians(degrees)
    foot, along = np.array([math.cos(t), math.sin(t)]), np.array([-math.sin(t), math.cos(t)])
    belief = mapped([wall(ORIGIN, [[1, -1], [1, 1]])])
    seen = wall(ORIGIN, [foot - along, foot + along])
    assert bool(belief.associate((seen,), Nearest()).matches) is matched


@pytest.mark.parametrize(("distance", "matched"), [(2.9, True), (3.1, False)])
def test_parallel_walls_match_by_their_feet(distance, matched):
    belief = mapped([wall(ORIGIN, [[1, -1], [1, 1]])])
    seen = wall(ORIGIN, [[distance, -1], [distance, 1]])
    assert bool(belief.associate((seen,), Nearest()).matches) is matched


@pytest.mark.parametrize("directed", [False, True])
def test_directed_walls_distinguish_the_two_sides_of_a_passage(directed):
    """Walls 1 m apart that face each other: the thesis takes 180 degrees for 0."""
    belief = mapped([wall(ORIGIN, [[3, 0.5], [1, 0.5]])])
    other = wall(ORIGIN, [[1, -0.5], [3, -0.5]])
    choice = belief.associate((other,), Nearest(directed=directed))
    assert bool(choice.matches) is not directed


@pytest.mark.parametrize(("frame", "matched"), [("map", False), ("base_link", True)])
def test_a_far_wall_is_recognised_from_the_robot_despite_the_heading(frame, matched):
    """Half a degree 400 m away moves the foot in map by 3.5 m, and the wall before the robot by 2 cm."""
    pose = np.array([400.0, 0.0, 0.0])
    belief = mapped([wall(ORIGIN, [[402, -1], [402, 1]])], pose)
    t = math.radians(0.5)
    turn = np.array([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]])
    seen = wall(ORIGIN, np.array([[2, -1], [2, 1]]) @ turn.T)
    choice = belief.associate((seen,), Nearest(frame=frame))
    assert bool(choice.matches) is matched
