"""Assignment of landmarks to the truth: found, missing, false and double ones."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from impslam.evaluation.landmarks import (
    corners,
    landmark_errors,
    score_landmarks,
    transform_landmarks,
    true_wall,
)
from impslam.geometry.se2 import inverse, transform
from impslam.simulation.world import load_world
from impslam.types import Landmark, TrueLandmark


@dataclass
class True_:
    name: str
    kind: str
    position: np.ndarray
    parameters: dict = field(default_factory=dict)
    end_points: np.ndarray | None = None


def line(a, b):
    a, b = np.array(a, float), np.array(b, float)
    along = (b - a) / np.linalg.norm(b - a)
    normal = np.array([-along[1], along[0]])
    r = float(normal @ a)
    if r < 0:
        r, normal = -r, -normal
    return r * normal, {"r": r, "alpha": math.atan2(normal[1], normal[0])}, np.array([a, b])


def a_wall(name, a, b):
    return True_(name, "wall", *line(a, b))


def wall(i, a, b):
    foot, parameters, ends = line(a, b)
    return Landmark(i, "wall", foot, parameters, np.eye(2), ends, 5, 0.0, 1.0)


def cylinder(i, x, y):
    return Landmark(i, "cylinder", np.array([x, y], float), {}, np.eye(2), None, 5, 0.0, 1.0)


def true_cylinder(name, x, y):
    return True_(name, "cylinder", np.array([x, y], float), {"radius": 0.1})


def test_points_are_assigned_so_that_the_sum_is_least():
    truth = [true_cylinder("a", 0, 0), true_cylinder("b", 0.4, 0)]
    # Greedy would take 1 for b (0.15) and leave a with 0.5.
    score = score_landmarks([cylinder(1, 0.25, 0), cylinder(2, 0.8, 0)], truth)
    assert [(e.name, e.id) for e in score.found] == [("a", 1), ("b", 2)]
    assert [e.distance for e in score.found] == pytest.approx([0.25, 0.4])


def test_missing_false_and_doubles():
    truth = [true_cylinder("a", 0, 0), true_cylinder("b", 9, 0)]
    score = score_landmarks([cylinder(1, 0.01, 0), cylinder(2, 0.2, 0), cylinder(3, 5, 5)], truth)
    assert [e.id for e in score.found] == [1]
    assert score.missing == ("b",)
    assert score.doubles == (2,)
    assert score.false == (3,)


def test_kinds_without_truth_are_ignored():
    corner = Landmark(9, "corner", np.zeros(2), {}, np.eye(2), None, 5, 0.0, 1.0)
    score = score_landmarks([corner, cylinder(1, 0, 0)], [true_cylinder("a", 0, 0)])
    assert score.false == ()
    assert score.doubles == ()


@pytest.mark.parametrize("estimates", [[], [cylinder(1, 0, 0)]])
@pytest.mark.parametrize("truth", [[], [true_cylinder("a", 0, 0)]])
def test_nothing_is_fine(estimates, truth):
    score = score_landmarks(estimates, truth)
    assert len(score.found) == min(len(estimates), len(truth))


def test_walls_are_scored_across_and_by_angle():
    truth = [a_wall("w", (0, 2), (4, 2))]
    (error,) = score_landmarks([wall(1, (1, 2.03), (3, 2.03))], truth).found
    assert error.distance == pytest.approx(0.03)
    assert error.angle == pytest.approx(0.0, abs=1e-12)
    assert error.foot == pytest.approx(0.03)


def test_the_distance_of_feet_grows_with_that_of_the_wall():
    tilt = 0.01
    truth = [a_wall("w", (50, 10), (54, 10))]
    ends = ((50, 10 - 2 * tilt), (54, 10 + 2 * tilt))
    (error,) = score_landmarks([wall(1, *ends)], truth).found
    assert error.distance == pytest.approx(0.0, abs=1e-9)
    assert error.angle == pytest.approx(math.atan(tilt))
    assert error.foot > 0.4


def test_a_walls_direction_and_side_do_not_matter():
    truth = [a_wall("w", (0, 0), (4, 0))]
    (error,) = score_landmarks([wall(1, (4, 0.01), (0, 0.01))], truth).found
    assert error.distance == pytest.approx(0.01)
    assert error.angle == pytest.approx(0.0, abs=1e-12)


def test_collinear_walls_five_metres_apart_are_two():
    truth = [a_wall("left", (0, 1), (2, 1)), a_wall("right", (7, 1), (9, 1))]
    score = score_landmarks([wall(1, (7, 1), (9, 1)), wall(2, (0.1, 1), (2, 1))], truth)
    assert [(e.name, e.id) for e in score.found] == [("left", 2), ("right", 1)]


def test_a_wall_across_is_not_the_wall():
    score = score_landmarks([wall(1, (1, -1), (1, 1))], [a_wall("w", (0, 0), (2, 0))])
    assert score.missing == ("w",)
    assert score.false == (1,)


def test_kinds_do_not_mix():
    score = score_landmarks([cylinder(1, 0, 0)], [True_("c", "corner", np.zeros(2))])
    assert score.missing == ("c",)


def test_corners_of_a_room() -> None:
    places = {tuple(corner.position) for corner in corners(load_world("room").landmarks())}
    assert places == {(-0.6, -0.8), (2.4, -0.8), (2.4, 1.8), (-0.6, 1.8)}


def test_a_point_is_a_cylinder_of_unknown_size_where_only_one_of_them_is_known():
    point = Landmark(3, "point", np.array([0.1, 0.0]), {}, np.eye(2), None, 5, 0.0, 1.0)
    truth = [true_cylinder("a", 0, 0)]
    assert [e.id for e in score_landmarks([point], truth).found] == [3]
    spot = True_("spot", "point", np.array([0.1, 0.0]))
    assert [e.name for e in score_landmarks([cylinder(1, 0, 0)], [spot]).found] == ["spot"]
    both = score_landmarks([point, cylinder(1, 0, 0)], [*truth, spot])
    assert [(e.name, e.id) for e in both.found] == [("a", 1), ("spot", 3)]


def test_the_wall_between_two_points_is_that_of_the_formulas():
    for a, b in (((0, 2), (4, 2)), ((3, -1), (-2, 5)), ((-1, -4), (6, -4))):
        foot, parameters, ends = line(a, b)
        wall_ = true_wall("w", ends)
        np.testing.assert_allclose(wall_.position, foot, atol=1e-12)
        assert wall_.parameters == pytest.approx(parameters)


MOTION = np.array([3.0, -2.0, 2.5])


def test_transform_landmarks():
    post = TrueLandmark("a", "cylinder", np.array([1.0, 2.0]), {"x": 1.0, "y": 2.0, "radius": 0.1})
    side = true_wall("w", np.array([[0.0, 1.0], [2.0, 3.0]]))
    post_, side_ = transform_landmarks(MOTION, [post, side])
    there = transform(MOTION, np.array([[1.0, 2.0], [0.0, 1.0], [2.0, 3.0]]))
    np.testing.assert_allclose(post_.position, there[0])
    assert post_.parameters == pytest.approx({"x": there[0, 0], "y": there[0, 1], "radius": 0.1})
    np.testing.assert_allclose(side_.end_points, there[1:])
    np.testing.assert_allclose(side_.position, line(*there[1:])[0])
    back = transform_landmarks(inverse(MOTION), [post_, side_])
    np.testing.assert_allclose(back[0].position, post.position, atol=1e-12)
    assert back[1].parameters == pytest.approx(dict(side.parameters))


def test_errors_match_the_parameters_of_the_covariance():
    np.testing.assert_allclose(
        landmark_errors(cylinder(1, 1.1, 1.8), true_cylinder("a", 1, 2)), [0.1, -0.2]
    )
    truth = true_wall("w", np.array([[0.0, 2.0], [4.0, 2.0]]))
    np.testing.assert_allclose(landmark_errors(wall(1, (0, 2.1), (4, 2.1)), truth), [0.1, 0.0])


def test_a_wall_through_the_origin_may_pass_on_its_other_side():
    truth = true_wall("w", np.array([[-2.0, 0.01], [2.0, 0.01]]))
    (r, alpha) = landmark_errors(wall(1, (-2, -0.02), (2, -0.02)), truth)
    assert abs(r) == pytest.approx(0.03)
    assert alpha == pytest.approx(0.0, abs=1e-12)
