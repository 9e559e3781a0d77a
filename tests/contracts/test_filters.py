"""What every filter keeps: exact without noise, consistent with it, the same whatever the frame."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from tests.filters.worlds import CYLINDERS, MODELS, drive, observe, step
from tests.numeric import wrapped

from impslam.association.known import Known
from impslam.component import components
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose
from impslam.types import Increment, Observation

FILTERS = sorted(components("filter"))


@pytest.fixture(params=FILTERS)
def belief(request):
    made = components("filter")[request.param]()
    made.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    return made


@cache
def noisy(steps, seed):
    """Return the poses, motions and observations of a drive; drawing them costs as much as a filter."""
    rng = np.random.default_rng(seed)
    return [(pose, motion, observe(pose, rng)) for pose, motion in drive(steps, rng)]


def test_noiseless_runs_are_exact(belief):
    """With noise told that is too small for means of what is bent to differ from what is seen."""
    belief.start(np.zeros(3), 1e-16 * np.eye(3), MODELS)
    for pose, increment in drive(60):
        motion = replace(increment, covariance=1e-8 * increment.covariance)
        seen = tuple(o.with_noise(1e-8 * o.R) for o in observe(pose))
        step(belief, motion, seen)
        assert np.abs(wrapped(belief.pose - pose, 2)).max() < 1e-9
    points = [m.position for m in belief.landmarks() if m.kind == "cylinder"]
    np.testing.assert_allclose(points, CYLINDERS, atol=1e-9)
    feet = [m.position for m in belief.landmarks() if m.kind == "wall"]
    np.testing.assert_allclose(feet, [[6, 0], [0, 5], [-6, 0], [0, -5]], atol=1e-9)


def test_monte_carlo_nees_is_chi_square(belief):
    """Pose NEES over runs is 3 and that of all landmarks jointly their dimension, within 99.9 % bounds."""
    runs, values, of_landmarks = 60, [], []
    for seed in range(runs):
        belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
        for _, increment, seen in (drawn := noisy(25, seed)):
            step(belief, increment, seen)
        error = wrapped(belief.pose - drawn[-1][0], 2)
        values.append(error @ np.linalg.solve(belief.covariance, error))
        if len(joint := belief.landmark_covariance()):
            off = landmark_errors(belief.landmarks())
            of_landmarks.append(off @ np.linalg.solve(joint, off))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs) / runs
    assert low < np.mean(values) < high
    if of_landmarks:
        low, high = chi2.ppf([0.0005, 0.9995], len(off) * runs) / runs
        assert low < np.mean(of_landmarks) < high


def landmark_errors(found):
    """Return the errors (2 k,) of the estimated values of the landmarks of `observe`, in its order."""
    walls = [[6.0, 0.0], [5.0, 0.5 * np.pi], [6.0, np.pi], [5.0, -0.5 * np.pi]]
    errors = np.array([values(mark) for mark in found]) - [*CYLINDERS, *walls]
    errors[len(CYLINDERS) :, 1] = wrap(errors[len(CYLINDERS) :, 1])
    return errors.ravel()


def values(mark):
    return [mark.parameters["r"], mark.parameters["alpha"]] if mark.is_line else mark.position


def test_the_joint_covariance_of_landmarks_has_their_own_on_its_diagonal(belief):
    rng = np.random.default_rng(3)
    for pose, increment in drive(10, rng):
        step(belief, increment, observe(pose, rng))
    joint, found = belief.landmark_covariance(), belief.landmarks()
    if not len(joint):
        assert belief.name.startswith("submaps")
        return
    assert joint.shape == (2 * len(found),) * 2
    np.testing.assert_allclose(joint, joint.T, atol=1e-15)
    for k, mark in enumerate(found):
        own = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(joint[own, own], mark.covariance, rtol=1e-9, atol=1e-15)


def test_innovations_are_chi_square(belief):
    d2 = []
    for _, increment, seen in noisy(150, 5):
        d2 += [m.distance2 for m in step(belief, increment, seen).matches]
    # Innovations of one scan share the pose's error, so the effective number is smaller.
    assert np.mean(d2) == pytest.approx(2.0, abs=0.25)


def test_covariance_stays_symmetric_positive_definite(belief):
    for _, increment, seen in noisy(400, 1):
        step(belief, increment, seen)
    P = belief.belief.covariance
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0


def test_order_of_observations_does_not_matter(belief):
    ends = []
    for flip in (1, -1):
        rng = np.random.default_rng(2)
        belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
        for pose, increment in drive(20, rng):
            step(belief, increment, observe(pose, rng)[::flip])
        ends.append(belief.pose)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_estimates_do_not_depend_on_where_the_map_frame_lies(belief):
    """The same run from another start pose gives the same path seen from that pose."""
    start, paths = np.array([40.0, -25.0, 2.5]), []
    for origin in (np.zeros(3), start):
        rng = np.random.default_rng(3)
        belief.start(origin, 1e-8 * np.eye(3), MODELS)
        path = []
        for pose, increment in drive(20, rng):
            step(belief, increment, observe(pose, rng))
            path.append(belief.pose)
        paths.append(path)
    for here, there in zip(*paths, strict=True):
        assert np.abs(wrapped(compose(start, here) - there, 2)).max() < 1e-6


def test_remove_forgets_one_landmark_and_nothing_else(belief):
    rng = np.random.default_rng(4)
    for pose, increment in drive(10, rng):
        step(belief, increment, observe(pose, rng))
    before = {m.id: m for m in belief.landmarks()}
    belief.remove([2, 6])
    after = {m.id: m for m in belief.landmarks()}
    assert set(before) - set(after) == {2, 6}
    for i, landmark in after.items():
        np.testing.assert_allclose(landmark.position, before[i].position)
        np.testing.assert_allclose(landmark.covariance, before[i].covariance)
    for pose, increment in drive(5, rng):
        step(belief, increment, observe(pose, rng))
    assert len(belief.landmarks()) == len(before)


def test_a_new_landmark_is_correlated_with_the_old_ones(belief):
    rng = np.random.default_rng(6)
    for pose, increment in drive(5, rng):
        step(belief, increment, observe(pose, rng))
    belief.predict(Increment(9.0, np.zeros(3), np.diag([0.5, 0.5, 0.01]) ** 2, 1.0))
    far = Observation("cylinder", np.array([1.0, 1.0]), 1e-4 * np.eye(2), label=50)
    belief.extend([far], 9.0)
    wide = belief.landmarks()[-1].covariance[0, 0]
    seen = observe(pose)
    choice = belief.associate(seen, Known())
    belief.correct(seen, choice.matches)
    assert belief.landmarks()[-1].covariance[0, 0] < 0.01 * wide


def test_a_correction_returns_its_joint_innovation(belief):
    """As `joint` has it before the correction, if the filter tells it at all."""
    rng = np.random.default_rng(7)
    for pose, increment in drive(5, rng):
        step(belief, increment, observe(pose, rng))
    belief.predict(Increment(9.0, np.zeros(3), np.diag([0.05, 0.05, 0.01]) ** 2, 1.0))
    seen = observe(pose, rng)
    matches = belief.associate(seen, Known()).matches
    nu, S = belief.joint(seen, matches)
    told = belief.correct(seen, matches)
    assert belief.correct(seen, ()) is None
    if told is not None:
        assert told.dof == len(nu)
        np.testing.assert_allclose(told.nis, nu @ np.linalg.solve(S, nu))
        np.testing.assert_allclose(told.log_det, np.linalg.slogdet(S)[1])


def test_joint_and_hypotheses_are_one_score(belief):
    """A pair judged alone has the innovation that it has among all pairs, and nearly its S.

    Not quite where a filter takes its Jacobians at other estimates than the newest.
    """
    rng = np.random.default_rng(9)
    for pose, increment in drive(8, rng):
        step(belief, increment, observe(pose, rng))
    seen = observe(pose, rng)
    matches = belief.associate(seen, Known()).matches
    innovation, S = belief.joint(seen, matches)
    np.testing.assert_allclose(S, S.T)
    for n, match in enumerate(matches):
        rows = slice(2 * n, 2 * n + 2)
        np.testing.assert_allclose(innovation[rows], match.innovation, atol=1e-12)
        np.testing.assert_allclose(S[rows, rows], match.S, atol=0.1 * np.trace(match.S))


@pytest.mark.parametrize("reach", [0.5, 10.0, 1e4])
def test_nothing_within_reach_is_left_out(belief, reach):
    """A scan with a bad pose: every pair of the full table that is in the gate is there."""
    rng = np.random.default_rng(10)
    for pose, increment in drive(8, rng):
        step(belief, increment, observe(pose, rng))
    belief.predict(Increment(9.0, np.zeros(3), np.diag([0.3, 0.3, 0.1]) ** 2, 1.0))
    seen = observe(compose(pose, np.array([0.3, -0.2, 0.08])), rng)
    some = belief.hypothesise(seen, lambda dof: reach)
    for part, whole in zip(some, belief.hypothesise(seen), strict=True):
        of_kind = [o for o in seen if o.kind == whole.kind]
        assert len(whole.distance2) == len(of_kind) * len(set(whole.landmarks.tolist()))
        key = {
            (o, k): p
            for p, (o, k) in enumerate(zip(part.observations, part.landmarks, strict=True))
        }
        assert len(key) < len(whole.distance2) or reach == 1e4
        assert list(key) == sorted(key)
        pairs = zip(whole.observations, whole.landmarks, strict=True)
        for p, pair in enumerate(pairs):
            if whole.distance2[p] <= reach:
                assert part.distance2[key[pair]] == pytest.approx(whole.distance2[p])
                assert part.log_det[key[pair]] == pytest.approx(whole.log_det[p])
                assert part.possible[key[pair]] == whole.possible[p]


def test_a_prediction_is_undone_to_the_bit(belief):
    rng = np.random.default_rng(11)
    for pose, increment in drive(8, rng):
        step(belief, increment, observe(pose, rng))
    P, mean = belief.belief.covariance, belief.belief.mean.copy()
    belief.predict(increment)
    assert not np.array_equal(belief.belief.mean, mean)
    belief.undo_predict()
    assert np.array_equal(belief.belief.covariance, P)
    assert np.array_equal(belief.belief.mean, mean)


def test_it_follows_another_estimate_and_continues_from_there(belief):
    """Its mean is that estimate; where it does not move, its covariance stays; it stays definite."""
    if not belief.follows:
        with pytest.raises(NotImplementedError, match="cannot follow another"):
            belief.follow(np.zeros(3), {})
        return
    rng = np.random.default_rng(8)
    for pose, increment in drive(12, rng):
        step(belief, increment, observe(pose, rng))
    ids = belief.outlines()[0].tolist()
    states = {
        number: table.states(belief.belief.mean)[k]
        for table in belief._atlas.tables()
        for k, number in enumerate(table.ids.tolist())
    }
    assert sorted(states) == sorted(ids)
    P = belief.covariance
    belief.follow(belief.pose, states)
    np.testing.assert_allclose(belief.covariance, P, rtol=1e-9)
    moved = {n: m + 0.01 * np.eye(len(m))[0] for n, m in states.items()}
    pose = belief.pose + np.array([0.02, -0.01, 7.0])
    belief.follow(pose, moved)
    np.testing.assert_allclose(wrapped(belief.pose - pose, 2), 0.0, atol=1e-12)
    for table in belief._atlas.tables():
        for k, number in enumerate(table.ids.tolist()):
            np.testing.assert_allclose(
                wrapped(table.states(belief.belief.mean)[k] - moved[number], -1), 0.0, atol=1e-12
            )
    assert np.linalg.eigvalsh(belief.belief.covariance)[0] > 0.0
