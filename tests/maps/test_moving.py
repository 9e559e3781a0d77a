"""A map that is moved: what it says of itself stays true, and what is relative stays."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.maps.drawn import mapped
from tests.recognition.plans import OFFICE, way

from impslam.errors import ImpError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose, transform
from impslam.landmarks.gps import GpsFrame
from impslam.maps.files import OCCUPIED, map_image
from impslam.maps.moving import moved_landmark
from impslam.types import Landmark

MOVES = [(0.0, 0.0, 0.4), (3.0, -2.0, -2.9), (-7.0, 1.0, 0.0)]


def wall(ends, covariance):
    """Return the wall with these ends (2, 2), m."""
    along = np.subtract(ends[1], ends[0])
    alpha = np.arctan2(-along[0], along[1])
    r = np.cos(alpha) * ends[0][0] + np.sin(alpha) * ends[0][1]
    r, alpha = (r, alpha) if r >= 0 else (-r, wrap(alpha + np.pi))
    foot = r * np.array([np.cos(alpha), np.sin(alpha)])
    values = {"r": float(r), "alpha": float(alpha)}
    return Landmark(1, "wall", foot, values, covariance, np.array(ends, float), 3, 0.0, 1.0)


@pytest.mark.parametrize("T", MOVES)
def test_relative_data_stay_and_the_path_moves(T):
    known = mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2))
    moved = known.moved(np.array(T))
    before, after = known.rows(), moved.rows()
    np.testing.assert_allclose(after.poses, compose(np.array(T), before.poses), atol=1e-12)
    np.testing.assert_allclose(
        between(after.poses[:-1], after.poses[1:]), between(before.poses[:-1], before.poses[1:]),
        atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(between(moved.live_poses, after.poses)[:, :2], 0.0, atol=1e-9)
    assert moved.edges is known.edges
    assert moved.keyframes.points is known.keyframes.points


@pytest.mark.parametrize("T", MOVES)
def test_an_error_is_as_likely_after_as_before(T, rng):
    known = mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2))
    rows = known.rows()
    error = 0.01 * rng.standard_normal(rows.poses.shape)
    truth = rows.poses - error
    moved = known.moved(np.array(T)).rows()
    other = moved.poses - compose(np.array(T), truth)
    other[:, 2] = wrap(other[:, 2])
    one = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows.covariances), error)
    two = np.einsum("ni,nij,nj->n", other, np.linalg.inv(moved.covariances), other)
    np.testing.assert_allclose(one, two, rtol=1e-6)


@pytest.mark.parametrize("T", [*MOVES, (-6.0, -6.0, 1.0)])
def test_a_wall_goes_with_its_ends(T):
    mark = wall([[2.0, 3.0], [4.0, 3.5]], np.diag([4e-4, 1e-4]))
    known = mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2), landmarks=[mark])
    (moved,) = known.moved(np.array(T)).landmarks
    expected = wall(transform(np.array(T), mark.end_points), mark.covariance)
    np.testing.assert_allclose(moved.end_points, expected.end_points, atol=1e-12)
    np.testing.assert_allclose(moved.position, expected.position, atol=1e-12)
    assert moved.parameters == pytest.approx(expected.parameters)


@pytest.mark.parametrize("T", [*MOVES, (-6.0, -6.0, 1.0)])
def test_the_covariance_of_a_wall_follows_its_parameters(T):
    def values(r, alpha):
        foot = r * np.array([np.cos(alpha), np.sin(alpha)])
        mark = Landmark(1, "wall", foot, {"r": r, "alpha": alpha}, P, None, 3, 0.0, 1.0)
        moved = moved_landmark(np.array(T), mark)
        return np.array([moved.parameters["r"], moved.parameters["alpha"]]), moved.covariance

    P = np.array([[4e-4, 5e-5], [5e-5, 1e-4]])
    step, J = 1e-6, np.empty((2, 2))
    for k, d in enumerate(step * np.eye(2)):
        J[:, k] = (values(3.0 + d[0], 0.5 + d[1])[0] - values(3.0 - d[0], 0.5 - d[1])[0]) / (
            2 * step
        )
    np.testing.assert_allclose(values(3.0, 0.5)[1], J @ P @ J.T, rtol=1e-6, atol=1e-12)


def test_a_point_turns_with_its_ellipse():
    mark = Landmark(
        2, "cylinder", np.array([1.0, 2.0]), {"radius": 0.1}, np.diag([4.0, 1.0]), None, 3, 0.0, 1.0
    )
    known = mapped(room(0, 4, 0, 3), way(1, 1, 3, 2, 3), landmarks=[mark])
    (moved,) = known.moved(np.array([1.0, 0.0, np.pi / 2])).landmarks
    np.testing.assert_allclose(moved.position, [-1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(moved.covariance, np.diag([1.0, 4.0]), atol=1e-12)
    assert moved.parameters == {"radius": 0.1}


@pytest.mark.parametrize("T", MOVES)
def test_a_gps_frame_predicts_the_same_fix_after_as_before(T):
    def fix(pose, mark):
        frame = np.array([[*mark.position, mark.parameters["yaw"]]])
        return GpsFrame().observe(pose, frame)

    pose, T = np.array([5.0, 4.0, 0.1]), np.array(T)
    mark = Landmark(0, "gps", np.array([2.0, 1.0]), {"yaw": 0.3}, np.eye(2), None, 5, 0.0, 1.0)
    moved = moved_landmark(T, mark)
    np.testing.assert_allclose(fix(compose(T, pose), moved), fix(pose, mark), atol=1e-12)
    assert -np.pi < moved.parameters["yaw"] <= np.pi


@pytest.mark.parametrize("T", [*MOVES, (-6.0, -6.0, 1.0)])
def test_errors_of_landmarks_are_jointly_as_likely_after_as_before(T, rng):
    ends = np.array([[2.0, 3.0], [4.0, 3.5]])
    root, error = 1e-4 * rng.standard_normal((4, 4)), 1e-6 * rng.standard_normal(4)
    P, T = root @ root.T, np.array(T)

    def marks(off):
        edge, post = wall(ends, P[:2, :2]), np.array([1.0, 2.0]) + off[2:]
        r, alpha = edge.parameters["r"] + off[0], edge.parameters["alpha"] + off[1]
        foot = r * np.array([np.cos(alpha), np.sin(alpha)])
        edge = replace(edge, position=foot, parameters={"r": r, "alpha": alpha})
        return edge, Landmark(2, "cylinder", post, {}, P[2:, 2:], None, 3, 0.0, 1.0)

    def moved_values(off):
        edge, post = (moved_landmark(T, mark) for mark in marks(off))
        return np.array([edge.parameters["r"], edge.parameters["alpha"], *post.position])

    known = mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2), landmarks=marks(np.zeros(4)))
    moved = replace(known, landmark_covariance=P).moved(T)
    after = moved_values(error) - moved_values(np.zeros(4))
    assert after @ np.linalg.solve(moved.landmark_covariance, after) == pytest.approx(
        error @ np.linalg.solve(P, error), rel=1e-4
    )


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.7, 1.2, 3.0])
def test_the_main_direction_is_that_of_the_walls(angle):
    direction = mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2, 20), T=(1.0, 2.0, angle)).direction()
    assert abs(wrap(4.0 * (direction.angle - angle)) / 4.0) < np.radians(0.1)
    assert -np.pi / 4 < direction.angle <= np.pi / 4
    assert direction.is_clear
    assert direction.sigma < np.radians(0.2)
    assert sum(direction.histogram) == pytest.approx(1.0)


def test_the_grid_of_a_straightened_room_has_its_walls_on_the_axes():
    known = mapped(room(0, 7, 0, 5), way(1.0, 1.5, 6.0, 3.0, 12), T=(2.0, -1.0, 0.35))
    image = map_image(known.straightened().grid())
    occupied = image.pixels == OCCUPIED
    left, right, bottom, top = image.extent
    assert right - left == pytest.approx(7.0, abs=0.2)
    assert top - bottom == pytest.approx(5.0, abs=0.2)
    inner = occupied[4:-4, 4:-4]
    assert occupied.sum() > 400
    assert not inner.any()


def test_oblique_walls_do_not_affect_the_main_direction():
    tent = np.array([[[7.0, 0.0], [9.0, 2.5]], [[9.0, 2.5], [7.0, 5.0]]])
    plan = np.concatenate([room(0, 7, 0, 5)[1:], tent])  # no right wall
    direction = mapped(plan, way(1.0, 1.5, 6.0, 3.0, 12)).direction()
    assert abs(direction.angle) < np.radians(0.1)


@pytest.mark.parametrize("sides", [3, 60])
def test_a_map_without_main_direction_is_not_straightened(sides):
    turns = 2.0 * np.pi * np.arange(sides) / sides
    corners = 4.0 * np.column_stack([np.cos(turns), np.sin(turns)])
    known = mapped(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), way(-1, 0, 1, 0.5, 6))
    assert not known.direction().is_clear
    with pytest.raises(ImpError, match="no main direction"):
        known.straightened()


def test_a_map_of_nothing_has_no_direction():
    known = mapped(room(50, 51, 50, 51), way(0, 0, 1, 0, 3))
    assert known.direction().share == 0.0
    assert np.isinf(known.direction().sigma)


def test_unplaced_keyframes_do_not_affect_the_direction():
    known = mapped(room(0, 7, 0, 5), way(1.0, 1.5, 6.0, 3.0, 12))
    poses, sessions = known.keyframes.poses.copy(), np.repeat([0, 1], [4, 8])
    poses[4:, 2] += 0.5
    rows = replace(known.keyframes, poses=poses, sessions=sessions, placed=sessions == 0)
    assert abs(replace(known, keyframes=rows).direction().angle) < np.radians(0.1)
