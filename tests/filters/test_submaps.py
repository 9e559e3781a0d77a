"""Submaps: what `ekf` knows, whatever the size of the map."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, observe, step
from tests.filters.worlds import drive as circle

from impslam.association.mahalanobis import Mahalanobis
from impslam.filters.ekf import Ekf
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.junction_tree import children, parent
from impslam.filters.submaps import SubmapEkf
from impslam.filters.submaps_fej import SubmapFirstEstimatesEkf
from impslam.geometry.se2 import compose, inverse, transform
from impslam.types import Increment, Observation

Q = np.diag([0.01, 0.005, 0.005]) ** 2
R = np.diag([1e-4, 2e-4])
WAY = np.array(
    [[1, 1], [19, 1], [19, 7], [1, 7], [1, 13], [19, 13], [1, 1], [13, 13], [19, 1]], float
)
PLACES = np.stack(np.meshgrid(np.arange(0, 20, 2.0), np.arange(0, 14, 2.0)), -1).reshape(-1, 2)


def drive(rng, noise=Q):
    """Yield poses and motions as felt, back and forth over 20 m by 14 m and through it again."""
    pose = np.array([*WAY[0], 0.0])
    for point in WAY[1:]:
        while np.hypot(*(point - pose[:2])) > 0.6:
            ahead = np.arctan2(*(point - pose[:2])[::-1]) - pose[2]
            turn = np.clip((ahead + np.pi) % (2 * np.pi) - np.pi, -0.5, 0.5)
            d = np.array([0.3 if abs(turn) < 0.5 else 0.1, 0.0, turn])
            pose = compose(pose, d)
            yield pose, Increment(0.0, d + rng.multivariate_normal(np.zeros(3), noise), noise, 0.1)


def seen(pose, rng):
    """Return the landmarks within 3 m."""
    points = transform(inverse(pose), PLACES)
    near = points[np.hypot(*points.T) < 3.0]
    noisy = near + rng.multivariate_normal(np.zeros(2), R, len(near))
    return tuple(Observation("cylinder", z, R) for z in noisy)


def both(rng, noise=Q, removing=True, kinds=(Ekf, SubmapEkf)):
    """Drive with both filters; yield them with the matches and innovations of each step."""
    filters, association = (kinds[0](), kinds[1](area=5.0, margin=1.0)), Mahalanobis()
    for belief in filters:
        belief.start(np.array([*WAY[0], 0.0]), 1e-6 * np.eye(3), MODELS)
    for k, (pose, motion) in enumerate(drive(rng, noise)):
        observations, told = seen(pose, rng), []
        for belief in filters:
            belief.predict(motion)
            choice = belief.associate(observations, association)
            innovation = belief.correct(observations, choice.matches)
            belief.note(observations, choice.matches, float(k))
            born = belief.extend([observations[i] for i in choice.new], float(k))
            told.append((innovation, [match[:2] for match in choice.matches], born))
        if removing and k % 40 == 30:  # some that other areas have seen, too
            gone = filters[1].outlines()[0][[0, 3, -1]].tolist()
            for belief in filters:
                belief.remove(gone)
        yield filters, told


@pytest.mark.parametrize(
    "kinds", [(Ekf, SubmapEkf), (FirstEstimatesEkf, SubmapFirstEstimatesEkf)], ids=["ekf", "fej"]
)
def test_a_drive_of_many_areas_is_that_of_the_dense_filter(kinds):
    """With revisits, births, removals and a loop: poses, covariances, matches, NIS, and the map."""
    most = 0
    for (dense, areas), (one, other) in both(np.random.default_rng(0), kinds=kinds):
        np.testing.assert_allclose(areas.pose, dense.pose, rtol=0, atol=1e-9)
        np.testing.assert_allclose(areas.covariance, dense.covariance, rtol=0, atol=1e-9)
        assert one[1:] == other[1:]
        if one[0] is not None:
            assert other[0].nis == pytest.approx(one[0].nis, abs=1e-6)
        most = max(most, len(areas.outlines()[0]))
    assert len(areas._areas) > 10
    assert most < 0.8 * len(PLACES)
    assert areas.state_size == dense.state_size
    marks, same = dense.landmarks(), areas.landmarks()
    assert [m.id for m in same] == [m.id for m in marks]
    for mark, twin in zip(marks, same, strict=True):
        np.testing.assert_allclose(twin.position, mark.position, rtol=0, atol=1e-9)
        np.testing.assert_allclose(twin.covariance, mark.covariance, rtol=0, atol=1e-9)
        assert (twin.observations, twin.last_stamp) == (mark.observations, mark.last_stamp)


def test_reading_the_map_changes_nothing():
    ends = []
    for read in (False, True):
        for k, ((_, areas), _told) in enumerate(both(np.random.default_rng(1))):
            if read and k % 10 == 0:
                areas.landmarks()
        ends.append((areas.pose, areas.covariance, areas.landmarks()))
    assert np.array_equal(ends[0][0], ends[1][0])
    assert np.array_equal(ends[0][1], ends[1][1])
    for one, other in zip(ends[0][2], ends[1][2], strict=True):
        assert np.array_equal(one.position, other.position)


def test_a_motion_without_noise_is_no_trouble():
    """Poses that areas have in common are then functions of each other, and P is singular."""
    for (dense, areas), _ in both(np.random.default_rng(2), np.zeros((3, 3)), removing=False):
        np.testing.assert_allclose(areas.pose, dense.pose, rtol=0, atol=1e-9)
        np.testing.assert_allclose(areas.covariance, dense.covariance, rtol=0, atol=1e-12)


def test_inactive_walls_are_updated_later_to_first_order():
    rng, dense, areas = np.random.default_rng(3), Ekf(), SubmapEkf(area=1.5)
    for belief in (dense, areas):
        belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    for pose, motion in circle(60, rng):
        observations = observe(pose, rng)
        for belief in (dense, areas):
            step(belief, motion, observations)
        sigma = np.sqrt(np.diag(dense.covariance))
        assert (np.abs(areas.pose - dense.pose) < 0.02 * sigma).all()
    assert len(areas._areas) > 4


def test_a_variable_is_in_all_cliques_between_two_that_have_it():
    """The running intersection of the junction tree: the nodes that have it are one tree."""
    *_, ((_, areas), _) = both(np.random.default_rng(0))
    cliques = areas._tree.cliques
    assert all(parent(below) == node for node in cliques for below in children(node))
    for code in np.unique(np.concatenate([c.codes for c in cliques.values()])).tolist():
        having = {node for node, clique in cliques.items() if code in clique.codes}
        edges = sum(parent(node) in having for node in having)
        assert edges == len(having) - 1


@pytest.mark.parametrize("seen", [(), (Observation("cylinder", np.array([0.5, 0.2]), R),)])
@pytest.mark.parametrize(
    ("dense", "areas"),
    [(Ekf(), SubmapEkf(area=1.0)), (FirstEstimatesEkf(), SubmapFirstEstimatesEkf(area=1.0))],
    ids=["ekf", "fej"],
)
def test_a_border_may_be_crossed_more_often_than_there_are_landmarks(dense, areas, seen):
    """Each crossing keeps a copy of the pose, also where nothing is seen."""
    for belief in (dense, areas):
        belief.start(np.zeros(3), 1e-6 * np.eye(3), MODELS)
        belief.extend(seen, 0.0)
        for k in range(120):
            belief.predict(Increment(float(k), np.array([1.0, 0.0, np.pi]), Q, 0.1))
    assert areas._cuts > 100
    np.testing.assert_allclose(areas.covariance, dense.covariance, rtol=1e-9)
    for one, other in zip(areas.landmarks(), dense.landmarks(), strict=True):
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9)
