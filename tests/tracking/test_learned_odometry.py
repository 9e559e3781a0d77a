"""The noise of odometry is learned from matches, but only from those that determine it."""

import numpy as np
import pytest

from impslam.geometry.se2 import compose
from impslam.tracking.learned_odometry import (
    START,
    UNLOCATED_NOISE,
    correct,
    initial_odometry,
    learn,
)

STEP = np.array([0.2, 0.0, 0.1])


def driven(located, error=(0.0, 0.0, 0.0), steps=2000):
    """Return what is learned on a drive on which matches differ from odometry by `error` per step."""
    learned, pose = initial_odometry(), np.zeros(3)
    for _ in range(steps):
        motion = STEP.copy()
        correct(learned, motion)
        pose = compose(pose, STEP + np.array(error))
        learn(learned, motion, STEP + np.array(error) - motion, True, pose, 1.0, located)
    return learned


def test_odometry_that_agrees_with_matches_is_trusted():
    learned = driven((True, True))
    assert (np.sqrt(learned.noise) < 0.1 * START).all()


@pytest.mark.parametrize(("located", "k"), [((False, True), 0), ((True, False), 1)])
def test_agreement_means_nothing_where_matches_determine_nothing(located, k):
    """The match is then that of odometry, and each would make the next one more so."""
    noise = np.sqrt(driven(located).noise)
    assert noise[k] >= min(START[k], UNLOCATED_NOISE[k]) - 1e-9
    assert noise[1 - k] < 0.1 * START[1 - k]


def test_the_scale_of_distance_is_learned_from_located_matches_only():
    error = (0.01, 0.0, 0.0)
    assert driven((True, True), error).bias[2] == pytest.approx(0.05, abs=0.005)
    assert driven((False, True), error).bias[2] == 0.0


def test_the_noise_of_a_bad_robot_is_known_after_a_few_segments():
    """Its heading drifts three times as much as `START` says; it has driven 20 m and turned by 10 rad."""
    rng, true, measured = np.random.default_rng(3), 0.15, []
    for _ in range(20):
        learned, pose = initial_odometry(), np.zeros(3)
        for _ in range(100):
            motion = STEP.copy()
            correct(learned, motion)
            moved = STEP.copy()
            moved[2] += true * np.sqrt(0.2 + 0.5 * 0.1) * rng.normal()
            pose = compose(pose, moved)
            learn(learned, motion, moved - STEP, False, pose, 1.0, (True, True))
        measured.append(np.sqrt(learned.noise[1]))
    assert np.median(measured) == pytest.approx(true, rel=0.2)
