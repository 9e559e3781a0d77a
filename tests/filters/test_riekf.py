"""The right-invariant EKF: what nothing observes stays unknown, to the last digit."""

from dataclasses import replace

import numpy as np
import pytest
from tests.filters.test_belief import random_belief
from tests.filters.worlds import MODELS, drive, observe, step
from tests.numeric import jacobian

from impslam.component import components
from impslam.filters.riekf import RightInvariantEkf, factors
from impslam.filters.symmetry import pose_D_motion
from impslam.geometry.se2 import compose, exp, inverse, transform
from impslam.landmarks.base import LandmarkModel
from impslam.landmarks.point import Point
from impslam.types import Increment, Match, Observation


@pytest.mark.parametrize("k", [0, 1, 3])
def test_one_pass_corrects_and_transforms(rng, k):
    """P becomes S (P - W W^T) S^T with S = I + A xi_D_pose on the pose."""
    belief, P, _, _ = random_belief(rng)
    n, size = belief.n, len(belief.P)
    A, xi_D_pose, W = rng.normal(size=(n, 3)), rng.normal(size=(3, 3)), rng.normal(size=(n, 4))
    A[:, k:] = 0.0
    A_T, W_T, of_pose = np.zeros((3, size)), np.zeros((4, size)), np.zeros((3, size))
    A_T[:, :n], W_T[:, :n], of_pose[:, :n] = A.T, 0.01 * W.T, P[:3]
    L, R = factors(W_T, A_T, xi_D_pose, of_pose)
    assert len(L) == 4 + 2 * k
    belief.subtract(L, R)
    S = np.eye(n)
    S[:, :3] += A @ xi_D_pose
    np.testing.assert_allclose(belief.covariance, S @ (P - 1e-4 * W @ W.T) @ S.T, atol=1e-10)


def test_pose_moves_with_the_map():
    pose = np.array([3.0, -2.0, 3.1])
    numeric = jacobian(lambda xi: compose(exp(xi), pose), np.zeros(3))
    np.testing.assert_allclose(pose_D_motion(pose), numeric, atol=1e-9)


START_SIGMA = 0.3


def noisy_run(belief, steps=80):
    """Yield after each step of a run with points and walls from a start known only roughly."""
    belief.start(np.zeros(3), START_SIGMA**2 * np.eye(3), MODELS)
    rng = np.random.default_rng(8)
    for pose, increment in drive(steps, rng):
        step(belief, increment, observe(pose, rng))
        yield belief


def about_a_motion_of_everything(belief):
    """Return the information (3, 3) that a belief holds about where robot and map lie as a whole."""
    G = np.empty((belief.state_size, 3))
    G[:3] = pose_D_motion(belief.pose)
    for table in belief._atlas.tables():
        G[table.columns] = table.model.m_D_motion(table.states(belief.belief.mean))
    return G.T @ np.linalg.solve(belief.belief.covariance, G)


@pytest.mark.parametrize("iterations", [1, 4])
def test_a_rigid_motion_of_everything_never_gains_information(iterations):
    """What the start gave can only fade: the eigenvalues of its information never grow."""
    last = np.eye(3) / START_SIGMA**2
    for belief in noisy_run(RightInvariantEkf(iterations=iterations, tolerance=1e-9)):
        now = about_a_motion_of_everything(belief)
        assert np.linalg.eigvalsh(last - now).min() > -1e-6
        last = now
    # Only the motion before the first landmark was seen took some of it away.
    assert np.linalg.eigvalsh(now).min() > 0.98 / START_SIGMA**2


def test_the_textbook_filter_gains_it_from_nothing():
    """On the same run the EKF ends far surer of the map's heading than it was at the start."""
    *_, belief = noisy_run(components("filter")["ekf"]())
    assert about_a_motion_of_everything(belief)[2, 2] > 2.0 / START_SIGMA**2


def test_reported_covariances_are_mean_squares_on_the_arc(rng):
    """A start known but for its heading: the far end of a drive lies on an arc, not a tangent."""
    sigma, way = 0.3, np.array([5.0, 0.0, 0.0])
    belief = RightInvariantEkf()
    belief.start(np.zeros(3), np.diag([1e-8, 1e-8, sigma**2]), MODELS)
    belief.predict(Increment(1.0, way, np.zeros((3, 3)), 1.0))
    belief.extend([Observation("cylinder", np.array([2.0, 1.0]), 1e-8 * np.eye(2))], 1.0)
    headings = sigma * rng.standard_normal(200_000)
    for reported, place in (
        (belief.covariance[:2, :2], way[:2]),
        (belief.landmarks()[0].covariance, np.array([7.0, 1.0])),
    ):
        c, s = np.cos(headings), np.sin(headings)
        swung = np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], axis=1) - place
        np.testing.assert_allclose(reported, swung.T @ swung / len(swung), rtol=0.15, atol=0.03)


class Weighed(LandmarkModel):
    """A point with a third number that is seen as it is, as third parties may define one."""

    dim, dim_z = 3, 3

    def observe(self, pose, m):
        return np.concatenate([transform(inverse(pose), m[..., :2]), m[..., 2:]], axis=-1)

    def invert(self, pose, z):
        return np.concatenate([transform(pose, z[..., :2]), z[..., 2:]], axis=-1)

    def outline(self, m, extents):
        return np.stack([m[..., :2], m[..., :2]], axis=-2)


def test_kinds_that_extend_a_point_are_transformed_too(rng):
    """What is added to the place neither swings nor moves with the map."""
    plain, weighed = RightInvariantEkf(), RightInvariantEkf()
    plain.start(np.zeros(3), 0.1 * np.eye(3), {"cylinder": Point()})
    weighed.start(np.zeros(3), 0.1 * np.eye(3), {"cylinder": Weighed()})
    for belief, dim in ((plain, 2), (weighed, 3)):
        noise = np.random.default_rng(4)
        for pose, increment in drive(10, noise):
            seen = [o for o in observe(pose, noise) if o.kind == "cylinder"]
            seen = [replace(o, z=np.append(o.z, 7.0)[:dim], R=4e-4 * np.eye(dim)) for o in seen]
            if belief.state_size == 3:
                initial = belief._belief.extend
                for o in seen:
                    m = np.append(transform(pose, o.z[:2]), 7.0)[:dim]
                    offset = initial(m, np.zeros((dim, 3)), 0.1 * np.eye(dim))
                    belief._atlas.add(pose, o, offset, m, 0.0)
            belief.predict(increment)
            belief.correct(seen, [Match(i, i, None, None, 0.0) for i in range(len(seen))])
    np.testing.assert_allclose(weighed.pose, plain.pose, atol=1e-9)  # its Jacobians are differences
    np.testing.assert_allclose(weighed.covariance, plain.covariance, atol=1e-9)
