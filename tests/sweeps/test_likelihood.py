"""Likelihood of innovations: its formula, and its maximum at the true noise."""

import math

import numpy as np
import pytest

from impslam.map import Revision
from impslam.sweeps.likelihood import InnovationLikelihood, negative_log_likelihood
from impslam.types import Innovation, Match, Observation


class Keyframe:
    """The part of a keyframe that `InnovationLikelihood` reads."""

    def __init__(self, *places):
        self.observations = tuple(Observation("point", np.array(z), np.eye(2)) for z in places)


def revision(*matches, innovation=None):
    zero = np.array([0]), np.zeros((1, 3)), np.zeros((1, 3, 3))
    return Revision(*zero, matches=matches, innovation=innovation)


def match(index, innovation, S):
    nu = np.array(innovation)
    return Match(index, 7, nu, S, float(nu @ np.linalg.solve(S, nu)))


def test_a_match_counts_by_its_density_and_a_new_observation_by_its_volume():
    S = np.array([[0.04, 0.01], [0.01, 0.09]])
    seen = InnovationLikelihood()
    seen.revise(Keyframe((1.0, -0.5), (3.0, 0.5)), revision(match(1, (0.1, -0.2), S)), None)
    nu = np.array([0.1, -0.2])
    density = math.exp(-0.5 * nu @ np.linalg.inv(S) @ nu) / math.sqrt(
        np.linalg.det(2.0 * math.pi * S)
    )
    assert seen.mean == pytest.approx(0.5 * (-math.log(density) + math.log(2.0 * 1.0)))


def test_the_mean_is_nan_without_matches():
    seen = InnovationLikelihood()
    seen.revise(Keyframe((1.0, 0.0)), revision(), None)
    assert math.isnan(seen.mean)


def test_the_minimum_is_at_the_true_noise(rng):
    sigma = 0.03
    innovations = rng.normal(0.0, sigma, (4000, 2))
    tried = np.array([0.01, 0.02, 0.025, 0.03, 0.035, 0.05, 0.1])
    mean = [
        np.mean(
            [
                negative_log_likelihood(revision(match(0, nu, s * s * np.eye(2))))
                for nu in innovations
            ]
        )
        for s in tried
    ]
    assert tried[int(np.argmin(mean))] == sigma


def test_a_joint_innovation_is_used_if_known():
    S = np.array([[0.04, 0.03], [0.03, 0.04]])
    nu = np.array([0.2, 0.19])
    told = Innovation(float(nu @ np.linalg.solve(S, nu)), 2, float(np.linalg.slogdet(S)[1]))
    one = match(0, nu, np.diag(np.diag(S)))
    jointly = 0.5 * (told.nis + told.log_det) + math.log(2.0 * math.pi)
    assert negative_log_likelihood(revision(one, innovation=told)) == pytest.approx(jointly)
    assert negative_log_likelihood(revision(one)) > jointly  # the common part explains both
