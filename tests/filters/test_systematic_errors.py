"""Constant errors of odometry are considered (Schmidt 1966), and that of a gyro's bias is learned."""

from dataclasses import replace

import numpy as np
import pytest
from tests.filters.worlds import MODELS, Q, drive, observe, step
from tests.numeric import jacobian, wrapped

from impslam.association.known import Known
from impslam.component import components
from impslam.geometry.se2 import compose, exp, log
from impslam.noise import SystematicErrors
from impslam.types import Increment, SystematicPart

FILTERS = components("filter")
FAMILY = sorted(name for name, cls in FILTERS.items() if cls.considers_shared_errors)
SIGMA = SystematicErrors(turn_per_distance=0.01, turn=0.03)
GYRO = SystematicErrors(0.02, 0.06, gyro_scale=0.02, gyro_bias=0.01, gyro_share=0.5)


def wrong(d_pose, e, sigma=SIGMA, seconds=1.0):
    """Return a motion along an arc as it is if odometry has errors e (k,) in standard deviations."""
    x, y, turn = log(d_pose)
    wheels, gyro = 1.0 - sigma.gyro_share, sigma.gyro_share
    sizes = [wheels * sigma.turn_per_distance * x, wheels * sigma.turn * turn]
    sizes += [gyro * sigma.gyro_scale * turn, gyro * sigma.gyro_bias * seconds]
    return exp(np.array([x, y, turn + np.dot(e, sizes[: len(e)])]))


def told(increment, random=None, sigma=SIGMA, before=None):
    """Return an increment that has systematic errors, too; `random` is the covariance of the others."""
    random = increment.covariance if random is None else random
    seconds = increment.duration
    replaced = np.diag([0.0, 0.0, float(sigma.turn_variances(increment.d_pose, seconds))])
    errors, correlation = (
        sigma.errors(increment.d_pose, seconds),
        sigma.correlation(before or sigma),
    )
    part = SystematicPart(errors, replaced, correlation, sigma.learned)
    return replace(increment, covariance=random + replaced, systematic=part)


def started(kind, pose=(0.4, -0.3, 0.7)):
    belief = FILTERS[kind]()
    belief.start(np.array(pose), np.zeros((3, 3)), MODELS)
    return belief


@pytest.mark.parametrize(("sigma", "count"), [(SIGMA, 2), (GYRO, 4)])
def test_errors_are_the_derivatives_of_a_motion(sigma, count):
    motions = [[0.12, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.003, 0.06], [-0.05, 0.001, -0.04]]
    true = [
        jacobian(lambda e, d=d: wrong(d, e, sigma, 0.3), np.zeros(count)) for d in np.array(motions)
    ]
    np.testing.assert_allclose(sigma.errors(np.array(motions), 0.3), true, atol=1e-5)


@pytest.mark.parametrize("kind", FAMILY)
def test_over_a_drive_they_add_up_however_it_is_cut(kind):
    """Against finite differences of the whole drive, of 2.4 m and 1.2 rad."""
    whole, none = np.array([2.4, 0.0, 1.2]), np.zeros((3, 3))
    start = np.array([0.4, -0.3, 0.7])
    D = jacobian(lambda e: compose(start, exp(log(wrong(exp(whole), e)))), np.zeros(2))
    for steps in (20, 60):
        belief = started(kind)
        for k in range(steps):
            belief.predict(told(Increment(float(k), exp(whole / steps), none, 0.1), none))
        P = belief.belief.pose_covariance()
        np.testing.assert_allclose(P, D @ D.T, atol=1e-3 * np.abs(P).max())


@pytest.mark.parametrize("kind", FAMILY)
def test_they_are_never_learned_and_correlate_with_the_landmarks(kind):
    rng, belief = np.random.default_rng(1), started(kind, np.zeros(3))
    for pose, increment in drive(30, rng):
        step(belief, told(increment), observe(pose, rng))
    at = list(belief.belief.errors.values())
    P = belief.belief.covariance
    np.testing.assert_array_equal(P[np.ix_(at, at)], np.eye(2))
    assert not belief.belief.mean[at].any()
    assert np.abs(P[at, 5:]).max() > 0.0
    assert np.linalg.eigvalsh(P).min() > -1e-12
    assert belief.state_size == len(P) - 2


@pytest.mark.parametrize("kind", FAMILY)
def test_undoing_a_prediction_restores_the_state_exactly(kind):
    rng, belief = np.random.default_rng(1), started(kind, np.zeros(3))
    for pose, increment in drive(5, rng):
        step(belief, told(increment), observe(pose, rng))
    P, mean = belief.belief.covariance, belief.belief.mean.copy()
    belief.predict(told(increment))
    assert np.abs(belief.belief.covariance - P).max() > 1e-6
    belief.undo_predict()
    np.testing.assert_array_equal(belief.belief.covariance, P)
    np.testing.assert_array_equal(belief.belief.mean, mean)


@pytest.mark.parametrize("kind", FAMILY)
def test_the_bias_of_a_gyro_is_learned_and_corrects_the_motion(kind):
    """Over 20 drives with errors of their own; the poses are then nearer to the truth."""
    sigma = GYRO._replace(gyro_share=1.0, gyro_scale=0.005)
    biases, sigmas, errors = [], [], {True: [], False: []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        belief, ignorant, true = started(kind, np.zeros(3)), started(kind, np.zeros(3)), np.zeros(3)
        e = np.append([0.0, 0.0], rng.standard_normal(2))
        for _, increment in drive(40):
            moved = wrong(increment.d_pose, e, sigma)
            true = compose(true, moved + rng.multivariate_normal(np.zeros(3), 0.01 * Q))
            motion = told(replace(increment, duration=1.0), 0.01 * Q, sigma)
            seen = observe(true, rng)
            step(belief, motion, seen)
            step(ignorant, replace(motion, systematic=None), seen)
            for learns, one in ((True, belief), (False, ignorant)):
                errors[learns].append(wrapped(one.pose - true, 2)[2])
        at = belief.belief.errors["odometry 3"]
        biases.append((belief.belief.mean[at] - e[3]) ** 2 / belief.belief.covariance[at, at])
        sigmas.append(np.sqrt(belief.belief.covariance[at, at]))
    assert max(sigmas) < 0.3
    assert 0.4 < np.mean(biases) < 2.2  # chi-square over 20 runs, 99.9 %
    assert np.std(errors[True]) < 0.9 * np.std(errors[False])


@pytest.mark.parametrize("kind", FAMILY)
@pytest.mark.parametrize(("first", "then"), [(0.01, 0.01), (0.01, 0.002), (0.001, 0.004)])
def test_errors_of_a_bias_that_changes_add_up_as_far_as_they_are_correlated(kind, first, then):
    """Half a minute each, before and after the bias was measured, or has drifted."""
    belief, none = started(kind, np.zeros(3)), np.zeros((3, 3))
    one, other = (GYRO._replace(gyro_share=1.0, gyro_bias=bias) for bias in (first, then))
    still = Increment(0.0, np.zeros(3), none, 30.0)
    belief.predict(told(still, none, one))
    belief.predict(told(still, none, other, before=one))
    common = min(first, then) ** 2  # the covariance of the two errors
    expected = 30.0**2 * (first**2 + then**2 + 2.0 * common)
    assert belief.belief.pose_covariance()[2, 2] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kind", FAMILY)
def test_undoing_a_prediction_restores_what_was_learned(kind):
    rng, belief = np.random.default_rng(1), started(kind, np.zeros(3))
    for pose, increment in drive(5, rng):
        step(belief, told(replace(increment, duration=1.0), sigma=GYRO), observe(pose, rng))
    P, mean = belief.belief.covariance, belief.belief.mean.copy()
    assert mean[belief.belief.errors["odometry 3"]] != 0.0
    later = GYRO._replace(gyro_bias=0.002)
    belief.predict(told(replace(increment, duration=1.0), sigma=later, before=GYRO))
    belief.undo_predict()
    np.testing.assert_array_equal(belief.belief.covariance, P)
    np.testing.assert_array_equal(belief.belief.mean, mean)


@pytest.mark.parametrize("kind", sorted(set(FILTERS) - set(FAMILY)))
def test_other_filters_take_them_as_random(kind):
    increment = Increment(1.0, np.array([0.3, 0.0, 0.15]), Q, 1.0)
    with_part, without = started(kind), started(kind)
    with_part.predict(told(increment))
    without.predict(replace(told(increment), systematic=None))
    np.testing.assert_array_equal(with_part.covariance, without.covariance)


def pose_nees(kind, scale, told_so, runs=40):
    """Return the mean NEES of the predicted poses over runs, each with constant errors of its own."""
    values, random = [], 0.01 * Q
    for seed in range(runs):
        rng, belief = np.random.default_rng(seed), started(kind, np.zeros(3))
        e, true = scale * rng.standard_normal(2), np.zeros(3)
        for _, increment in drive(30):
            true = compose(true, wrong(increment.d_pose, e))
            noise = rng.multivariate_normal(np.zeros(3), random)
            felt = replace(increment, d_pose=increment.d_pose + noise, covariance=random)
            felt = told(felt) if scale else felt
            belief.predict(felt if told_so else replace(felt, systematic=None))
            error = wrapped(belief.pose - true, 2)
            values.append(error @ np.linalg.solve(belief.belief.pose_covariance(), error))
            seen = observe(true, rng)
            choice = belief.associate(seen, Known())
            belief.correct(seen, choice.matches)
            belief.extend([seen[i] for i in choice.new], increment.stamp)
    return float(np.mean(values))


@pytest.mark.parametrize("kind", ["ekf", "riekf"])
def test_poses_are_as_consistent_as_without_systematic_errors(kind):
    """Taken as drawn anew, short motions seem too uncertain."""
    without = pose_nees(kind, 0.0, told_so=False)
    assert pose_nees(kind, 1.0, told_so=True) == pytest.approx(without, rel=0.15)
    assert pose_nees(kind, 1.0, told_so=False) < 0.7 * without
