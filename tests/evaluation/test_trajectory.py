"""Errors of trajectories: exact where they can be, invariant where they must be."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.errors import ImpError
from impslam.evaluation.trajectory import (
    PosePairs,
    align,
    associate,
    ate,
    heading_errors,
    interpolate,
    interpolation_error,
    misfit,
    position_errors,
    rpe,
    start_frame,
    statistics,
)
from impslam.geometry.se2 import compose, transform

motion = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)).map(np.array)


def circle(n=100):
    t = np.linspace(0.0, 10.0, n)
    return np.c_[t, 2 * np.cos(t), 2 * np.sin(t), np.arctan2(np.cos(t), -np.sin(t))]


@settings(deadline=None)  # compiles
@given(motion)
def test_alignment_undoes_any_motion(T):
    points = circle()[:, 1:3]
    found = align(transform(T, points), points)
    np.testing.assert_allclose(compose(found, T), 0.0, atol=1e-9)


def test_alignment_never_mirrors(rng):
    points = rng.normal(size=(20, 2))
    mirrored = points * [1.0, -1.0]
    error = transform(align(points, mirrored), points) - mirrored
    assert np.abs(error).max() > 0.1


def lap(rng):
    """A path that looks like no other part of itself, and a truth 1 cm from it in another frame."""
    t = np.linspace(0.0, 10.0, 200)
    path = np.c_[4 * np.cos(t), 2 * np.sin(t) + 0.2 * t, 0.3 * t]
    truth = compose(np.array([5e5, -3e6, 2.0]), path)
    return t, path, truth + np.c_[rng.normal(0.0, 0.01, (200, 2)), np.zeros(200)]


@pytest.mark.parametrize("scale", [1.0, 1.03, 0.97])
def test_a_truth_that_fits_is_not_doubted(rng, scale):
    t, path, truth = lap(rng)
    truth[:, :2] *= scale
    assert misfit(PosePairs(t, path, truth)) == ""
    truth[:, 2] = np.nan
    assert misfit(PosePairs(t, path, truth)) == ""
    line = np.c_[t, np.zeros_like(t), np.zeros_like(t)]
    assert misfit(PosePairs(t, line, line * [1.0, -1.0, 1.0])) == ""
    standing = np.zeros((200, 3))
    assert misfit(PosePairs(t, standing, truth)) == misfit(PosePairs(t, path, standing)) == ""


def test_a_path_that_is_wrong_is_not_the_fault_of_the_truth(rng):
    t, path, truth = lap(rng)
    bent = compose(np.c_[np.zeros((200, 2)), 0.1 * t], path)
    assert misfit(PosePairs(t, bent, truth)) == ""


@pytest.mark.parametrize(("unit", "said"), [(1000.0, "is 1000 times"), (0.3048, "is 0.3048 times")])
def test_a_truth_in_another_unit_is_named(rng, unit, said):
    t, path, truth = lap(rng)
    assert said in misfit(PosePairs(t, path, truth * [unit, unit, 1.0]))


def test_a_mirrored_truth_is_named(rng):
    t, path, truth = lap(rng)
    assert "mirrored" in misfit(PosePairs(t, path, truth * [1.0, -1.0, -1.0]))
    assert "mirrored" in misfit(PosePairs(t, path, truth * [1e3, -1e3, -1.0]))


def test_headings_of_a_body_that_is_mounted_otherwise_are_named(rng):
    t, path, truth = lap(rng)
    truth[:, 2] += math.pi / 2.0
    assert "by 90 deg (median)" in misfit(PosePairs(t, path, truth))


def test_alignment_is_the_best_motion(rng):
    points = rng.normal(size=(30, 2))
    target = transform(np.array([1.0, 2.0, 0.5]), points) + 0.1 * rng.normal(size=(30, 2))
    best = align(points, target)

    def cost(T):
        return np.sum((transform(T, points) - target) ** 2)

    for nudge in 1e-3 * np.vstack((np.eye(3), -np.eye(3))):
        assert cost(best + nudge) > cost(best)


def test_alignment_of_a_robot_that_stood_still():
    T = align(np.ones((5, 2)), np.full((5, 2), 3.0))
    np.testing.assert_allclose(T, [2.0, 2.0, 0.0])


@settings(deadline=None)  # compiles
@given(motion)
def test_the_absolute_error_of_a_moved_copy_is_zero_only_after_alignment(T):
    truth = circle()
    estimate = np.c_[truth[:, 0], compose(T, truth[:, 1:])]
    pairs = associate(estimate, truth)
    assert ate(pairs).max < 1e-8
    np.testing.assert_allclose(heading_errors(pairs.aligned()), 0.0, atol=1e-9)
    expected = np.hypot(*(estimate[:, 1:3] - truth[:, 1:3]).T)
    np.testing.assert_allclose(position_errors(pairs), expected, atol=1e-9)


def test_statistics_of_known_errors():
    s = statistics(np.array([-3.0, 4.0, 0.0, 0.0]))
    assert (s.count, s.rmse, s.mean, s.median, s.max) == (4, 2.5, 1.75, 1.5, 4.0)


def test_interpolation_goes_through_pi_the_short_way():
    rows = np.array([[0.0, 0.0, 0.0, 3.0], [1.0, 2.0, 4.0, -3.0]])
    np.testing.assert_allclose(interpolate(rows, np.array([0.5])), [[1.0, 2.0, math.pi]])


def test_interpolation_does_not_need_ordered_stamps():
    rows = circle()
    shuffled = rows[np.random.default_rng(0).permutation(len(rows))]
    stamps = np.linspace(0, 10, 31)
    np.testing.assert_array_equal(interpolate(shuffled, stamps), interpolate(rows, stamps))


def test_stamps_outside_the_truth_or_in_its_holes_are_left_out():
    truth = np.c_[[0.0, 1.0, 5.0, 5.5], np.zeros((4, 3))]
    stamps = np.array([-1.0, -0.05, 0.5, 1.0, 3.0, 5.0, 5.2, 5.55, 6.0])
    pairs = associate(np.c_[stamps, np.zeros((9, 3))], truth)
    np.testing.assert_array_equal(pairs.stamps, [-0.05, 0.5, 1.0, 5.0, 5.2, 5.55])


def test_a_single_true_pose_can_be_compared_with():
    assert len(associate(circle(), circle()[:1]).stamps) == 1


def test_no_common_time_is_one_line():
    late = circle() + np.array([100.0, 0, 0, 0])
    with pytest.raises(ImpError, match="do not overlap in time"):
        associate(late, circle())


def test_a_truth_that_is_too_sparse_is_not_said_to_be_of_another_time():
    estimate = np.column_stack((np.arange(0.0, 10.0, 0.1), np.zeros((100, 3))))
    truth = np.column_stack((np.arange(0.03, 10.0, 2.0), np.zeros((5, 3))))
    with pytest.raises(ImpError, match=r"more than 1 s apart, .*; give a truth with more poses"):
        associate(estimate[5:85], truth)


@pytest.mark.parametrize(("seconds", "begin"), [(1.0, 0.0), (0.5, 0.1), (0.1, 1.7e9)])
def test_the_error_of_an_interpolated_circle_is_known(seconds, begin):
    """A chord of a circle with the acceleration a is off by a t (h - t) / 2."""
    t = begin + np.arange(0.0, 30.0, 0.01)
    path = np.c_[t, np.cos(t - begin), np.sin(t - begin), t - begin]
    truth = path[:: round(100 * seconds)]
    inside = path[t <= truth[-1, 0]]
    off = interpolate(truth, inside[:, 0]) - inside[:, 1:]
    found = interpolation_error(truth, inside[:, 0])
    assert found == pytest.approx(np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)), rel=0.07)
    assert interpolation_error(truth, truth[:, 0]) == pytest.approx(0.0, abs=1e-9)
    assert interpolation_error(truth[:2], inside[:, 0]) == 0.0


def test_relative_error_of_a_scaled_path():
    x = np.linspace(0.0, 10.0, 101)
    truth = np.c_[x, np.zeros((101, 2))]
    estimate = truth * [1.02, 1.0, 1.0]
    metres, radians = rpe(PosePairs(x, estimate, truth), 1.0)
    assert metres.count == 91
    assert metres.rmse == pytest.approx(0.02)
    assert radians.max == 0.0


@settings(deadline=None)  # compiles
@given(motion)
def test_relative_error_does_not_depend_on_the_frame(T):
    truth = circle()[:, 1:]
    estimate = truth + [0.01, -0.02, 0.03] * np.sin(np.arange(100.0))[:, None]
    stamps = circle()[:, 0]
    here = rpe(PosePairs(stamps, estimate, truth), 1.0)
    there = rpe(PosePairs(stamps, estimate, truth).moved(T), 1.0)
    assert here[0].rmse == pytest.approx(there[0].rmse, rel=1e-6)


@pytest.mark.parametrize("delta", [1e6, 0.0])
def test_stretches_that_cannot_be_are_one_line(delta):
    with pytest.raises(ImpError, match="rpe over"):
        rpe(PosePairs(circle()[:, 0], circle()[:, 1:], circle()[:, 1:]), delta)


def positions(rows):
    return np.c_[rows[:, :3], np.full(len(rows), np.nan)]


def test_a_truth_of_positions_scores_positions():
    truth, estimate = circle(), circle() + np.array([0.0, 0.3, 0.4, 0.2])
    pairs = associate(estimate, positions(truth))
    assert ate(pairs, aligned=False).rmse == pytest.approx(0.5)
    assert ate(pairs).max < 1e-9
    assert np.isnan(heading_errors(pairs)).all()
    assert statistics(heading_errors(pairs)).count == 0
    metres, radians = rpe(pairs, 1.0)
    assert metres.count == radians.count == 0
    assert math.isnan(metres.rmse)


def test_headings_are_known_between_known_ones_only():
    rows = np.array([[0.0, 0, 0, 3.0], [1, 1, 0, -3.0], [2, 2, 0, np.nan], [3, 3, 0, 0.5]])
    stamps = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    headings = interpolate(rows, stamps)[:, 2]
    np.testing.assert_allclose(headings, [math.pi, -3.0, np.nan, np.nan, np.nan, 0.5])
    np.testing.assert_allclose(interpolate(rows, stamps)[:, 0], stamps)


def test_headings_around_one_that_is_not_known_do_not_jump():
    t = np.linspace(0.0, 3.0, 31)
    rows = np.c_[t, t, t, 4.0 * t]
    rows[7, 3] = np.nan
    between_rows = interpolate(rows, np.array([2.25]))
    assert between_rows[0, 2] == pytest.approx(9.0 - 2 * math.pi)


@settings(deadline=None)  # compiles
@given(motion)
def test_the_true_start_undoes_any_frame(T):
    rows = circle()
    truth = np.c_[rows[:, 0], compose(T, rows[:, 1:])]
    found = start_frame(associate(rows, truth), 0.0)
    np.testing.assert_allclose(np.sin((found - T) / [100, 100, 1]), 0.0, atol=1e-9)


def test_the_start_is_where_a_heading_is_first_known_if_it_is_soon():
    truth = circle()
    truth[:3, 3] = np.nan
    pairs = associate(circle() + np.array([0, 1.0, 0, 0]), truth)
    np.testing.assert_allclose(start_frame(pairs, 0.0), [-1, 0, 0], atol=1e-12)
    assert start_frame(pairs, -2.0) is None
    truth[:20, 3] = np.nan
    assert start_frame(associate(circle(), truth), 0.0) is None
    assert start_frame(associate(circle(), positions(truth)), 0.0) is None


def test_positions_at_5_hz_with_a_hole_are_interpolated_outside_the_hole_only():
    t = np.concatenate((np.arange(0.0, 4.01, 0.2), np.arange(6.0, 9.01, 0.2)))
    truth = np.c_[t, 2.0 * t, -t, np.full(len(t), np.nan)]
    stamps = np.arange(0.0, 9.0, 0.1)
    pairs = associate(np.c_[stamps, np.zeros((90, 3))], truth)
    assert not ((pairs.stamps > 4.05) & (pairs.stamps < 5.95)).any()
    assert len(pairs.stamps) == 90 - 19
    np.testing.assert_allclose(pairs.truth[:, 0], 2.0 * pairs.stamps, atol=1e-9)
