"""Chains of motions agree with the composition of single ones, to rounding."""

import numpy as np
import pytest

from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.se2 import compose, compose_uncertain


@pytest.fixture
def parts(rng):
    def spread():
        A = rng.normal(size=(3, 3))
        return A @ A.T

    return [(rng.normal(0.0, 2.0, 3), spread()) for _ in range(20)]


def test_a_chain_is_the_composition_of_its_parts(parts):
    pose, P = np.array([0.5, -1.0, 3.0]), 0.1 * np.eye(3)
    expected = pose.copy(), P.copy()
    for d_pose, Q in parts:
        advance(pose, P, d_pose, Q)
        expected = compose_uncertain(*expected, d_pose, Q)
        np.testing.assert_allclose(pose, expected[0], atol=1e-12)
        np.testing.assert_allclose(P, expected[1], rtol=1e-12, atol=1e-12)
        assert (P == P.T).all()


def test_a_pose_moves_alike_without_its_covariance(parts):
    pose = np.array([0.5, -1.0, 3.0])
    expected = pose.copy()
    for d_pose, _ in parts:
        advance_pose(pose, d_pose)
        expected = compose(expected, d_pose)
    np.testing.assert_allclose(pose, expected, atol=1e-12)
