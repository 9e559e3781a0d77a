"""What one scan cannot tell is kept open, later ones settle it, and the path is revised."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t
from tests.association.scenes import mapped, point
from tests.filters.worlds import MODELS, drive, observe
from tests.numeric import wrapped

from impslam.component import build
from impslam.errors import NumericalError
from impslam.estimators.hypotheses import MultipleHypotheses
from impslam.filters.ekf import Ekf
from impslam.geometry.se2 import compose
from impslam.map import Keyframe
from impslam.types import Increment

ORIGIN = np.zeros(3)
STILL = (1e-4, 1e-4, 1e-5)


def started(**parameters):
    made = MultipleHypotheses(**parameters)
    made.start(ORIGIN, models=MODELS, filter=build("filter", {"kind": "riekf"}))
    return made


def keyframe(k, seen=(), moved=ORIGIN, sigma=STILL):
    motion = Increment(float(k), np.asarray(moved, float), np.diag(np.square(sigma)), 1.0)
    none = np.zeros((3, 3))
    return Keyframe(k, float(k), motion, none[0], none[0], none, None, 0, observations=tuple(seen))


TWINS = ((3.0, 0.0), (3.0, 0.4))
FAR = (0.0, 3.0)
ASTRAY = np.array([0.0, 0.4, 0.0])
"""Where the robot gets to while it believes to stand: the second twin is seen where the first was."""


def ambiguous(**parameters):
    """A map of two twins and one far landmark; then the robot strays, and sees one of the twins."""
    made = started(**parameters)
    for k in range(2):
        made.add(keyframe(k, [point(ORIGIN, place) for place in (*TWINS, FAR)]))
    told = made.add(keyframe(2, [point(ASTRAY, TWINS[1])], sigma=(0.3, 0.3, 1e-3)))
    return made, told


def test_an_ambiguous_match_is_not_reported_and_the_pose_is_uncertain():
    _, told = ambiguous()
    assert told.matches == ()
    assert told.poses[0][1] == pytest.approx(0.0, abs=0.05)  # the likelier one, and wrong
    assert 0.1 < math.sqrt(told.covariances[0][1, 1]) < 0.25  # both are 0.4 m apart


def test_a_later_scan_resolves_the_ambiguity_and_revises_the_path():
    made, _ = ambiguous()
    told = made.add(keyframe(3, [point(ASTRAY, FAR), point(ASTRAY, TWINS[1])]))
    assert told.ids.tolist() == [2, 3]  # the newest one is the last, as observers expect
    np.testing.assert_allclose(told.poses[:, :2], [ASTRAY[:2]] * 2, atol=0.03)
    assert {m.observation: m.landmark for m in told.matches} == {0: 2, 1: 1}
    assert len(made.landmarks()) == 3
    assert made.add(keyframe(4, [point(ASTRAY, FAR)])).ids.tolist() == [4]


def test_a_single_hypothesis_takes_the_likelier_landmark():
    made, _ = ambiguous(max_hypotheses=1)
    told = made.add(keyframe(3, [point(ASTRAY, FAR), point(ASTRAY, TWINS[1])]))
    assert told.ids.tolist() == [3]


def test_objects_in_one_scan_are_distinct_landmarks():
    """However near to each other, and however unsure the pose is."""
    made = started()
    made.add(keyframe(0, [point(ORIGIN, (3.0, 0.0))]))
    seen = [point(ORIGIN, (3.0, 0.0)), point(ORIGIN, (3.0, 0.06))]
    for k in range(1, 5):
        made.add(keyframe(k, seen, sigma=(0.1, 0.1, 0.01)))
    assert len(made.landmarks()) == 2
    assert min(len(h.filter.landmarks()) for h in made._hypotheses) == 2


def test_equal_hypotheses_are_merged():
    """Most ambiguities of a drive stop to matter: the beliefs converge."""
    kept = []
    for same in (0.0, 0.2):
        made, rng, pose = (
            started(merge_distance=same, density=3.0),
            np.random.default_rng(1),
            ORIGIN,
        )
        for k in range(20):
            moved = np.array([0.1, 0.0, 0.1])
            pose = compose(pose, moved)
            seen = [point(pose, place, rng=rng) for place in (*TWINS, FAR)]
            made.add(keyframe(k, seen, moved, (0.02, 0.02, 0.01)))
        kept.append(len(made._hypotheses))
    assert kept[0] == 20
    assert kept[1] < 15


def test_an_ambiguous_match_without_effect_is_not_reported():
    """Halfway between twins the odds are even, and either match leaves the same belief."""
    made = started(merge_distance=1.0, density=1e-9)
    near = ((3.0, 0.0), (3.0, 0.03))
    for k in range(20):
        told = made.add(keyframe(k, [point(ORIGIN, place) for place in near]))
    assert len(told.matches) == 2
    told = made.add(keyframe(20, [point(ORIGIN, (3.0, 0.015))]))
    assert told.matches == ()


def test_agreement_uses_the_noise_of_a_single_scan():
    """Errors that repeat make a correction weak, and do not make a scan any less sharp."""
    made = started()
    made._hypotheses[0].filter = Ekf(repeats=100.0)
    made._hypotheses[0].filter.start(ORIGIN, 1e-8 * np.eye(3), MODELS)
    for k in range(3):
        told = made.add(keyframe(k, [point(ORIGIN, (3.0, 0.0)), point(ORIGIN, (3.0, 0.2))]))
    told = made.add(keyframe(3, [point(ORIGIN, (3.0, 0.2))]))
    assert {m.observation: m.landmark for m in told.matches} == {0: 1}


def test_a_drive_is_mapped_without_labels_as_with_them():
    rng, made, labels = np.random.default_rng(2), started(), []
    for k, (pose, motion) in enumerate(drive(40, rng)):
        seen = observe(pose, rng)
        labels += [o.label for o in seen]  # a landmark's id is the number of the observation
        told = made.add(keyframe(k, seen, motion.d_pose, np.sqrt(np.diag(motion.covariance))))
        assert all(labels[m.landmark] == seen[m.observation].label for m in told.matches)
    marks = made.landmarks()
    assert {labels[m.id] for m in marks} == set(labels)
    assert len(marks) <= 11
    off = wrapped(told.poses[0] - pose, 2)
    assert off @ np.linalg.solve(told.covariances[0], off) < 16.3  # 99.9 % of three


def test_densities_are_those_of_the_noise_that_corrects():
    belief = mapped([point(ORIGIN, (2, 1))], sigma=(0.05, 0.03, 0.02))
    seen = (point(ORIGIN, (2.1, 1.05)),)
    (match,) = belief.hypothesise(seen)[0].matches([0])
    nu, S, R = match.innovation, match.S, seen[0].R
    normal = multivariate_normal(np.zeros(2), S)
    assert belief.log_densities(seen, [match]) == pytest.approx([normal.logpdf(nu)])
    heavy = Ekf(dof=4.0, repeats=8.0).log_densities(seen, [match])
    assert heavy == pytest.approx([multivariate_t(np.zeros(2), S + 7.0 * R, df=4).logpdf(nu)])
    alone = Ekf(dof=4.0, repeats=8.0).log_densities(seen, [match], alone=True)
    assert alone == pytest.approx([multivariate_t(np.zeros(2), S, df=4).logpdf(nu)])


def test_a_copy_is_independent_and_distinguished_once_it_differs():
    one = mapped([point(ORIGIN, (2, 1))], sigma=(0.05, 0.03, 0.02))
    other = one.copied()
    assert one.resembles(other, 1e-9)
    before = one.pose, one.belief.covariance
    seen = (point(ORIGIN, (2.1, 1.05)),)
    other.correct(seen, other.hypothesise(seen)[0].matches([0]))
    np.testing.assert_array_equal(one.pose, before[0])
    np.testing.assert_array_equal(one.belief.covariance, before[1])
    assert not one.resembles(other, 0.2)
    assert one.resembles(other, 10.0)
    other.extend(seen, 2.0)
    assert not one.resembles(other, 10.0)


def failing(method, *calls):
    """Return the method of a filter, which fails at some of its calls: 0, 1, ..."""
    count = itertools.count()

    def fail(*arguments):
        if next(count) in calls:
            raise NumericalError("an innovation is not positive definite")
        return method(*arguments)

    return fail


def test_a_scan_that_fails_halfway_moves_the_robot_once_and_changes_nothing_else(monkeypatch):
    made, twin = started(), started()
    for one in (made, twin):
        one.add(keyframe(0, [point(ORIGIN, FAR), point(ORIGIN, TWINS[0])]))
    moved = np.array([0.5, 0.0, 0.1])
    with monkeypatch.context() as patch:
        patch.setattr(Ekf, "hypothesise", failing(Ekf.hypothesise, 1))
        seen = [point(moved, FAR), point(moved, TWINS[0])]
        told = made.add(keyframe(1, seen, moved, (0.1, 0.1, 0.1)))
    assert "not positive definite" in told.refused
    by_motion = twin.add(keyframe(1, (), moved, (0.1, 0.1, 0.1)))
    np.testing.assert_array_equal(told.poses, by_motion.poses)
    np.testing.assert_array_equal(told.covariances, by_motion.covariances)
    after, expected = (one.add(keyframe(2, seen)) for one in (made, twin))
    np.testing.assert_array_equal(after.poses, expected.poses)
    assert [m.id for m in made.landmarks()] == [m.id for m in twin.landmarks()]


def test_a_branch_without_a_solution_is_dropped(monkeypatch):
    """The likelier twin cannot be corrected, so that the other one is believed at once."""
    monkeypatch.setattr(Ekf, "correct", failing(Ekf.correct, 6))
    made, told = ambiguous()
    assert told.refused == ""
    assert told.poses[0][1] == pytest.approx(ASTRAY[1], abs=0.05)
    assert len(made.landmarks()) == 3
