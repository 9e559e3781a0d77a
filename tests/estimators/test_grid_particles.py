"""The grid particle filter: its draws are the motion's and the scan's, and loops close by choice."""

import numpy as np
import pytest
from tests.estimators.drives import (
    LAP,
    RING,
    SIGMA,
    driven,
    keyframe,
    keyframes,
    motions,
    scanned,
    way,
)
from tests.filters.worlds import MODELS
from tests.numeric import wrapped

from impslam.estimators.grid_kernels import ancestors, lineage
from impslam.estimators.grid_particles import GridParticles
from impslam.geometry.se2 import compose

TRUTH = way(*LAP, LAP[1])
DRIFT = (0.004, -0.003, 0.0007)  # m, m, rad in a metre: 0.4 m and 2 deg in a lap


def begun(start=TRUTH[0], **how):
    made = GridParticles(**how)
    made.start(np.array(start, float), models=MODELS)
    return made


@pytest.fixture(scope="module")
def frames():
    return keyframes(RING, TRUTH, DRIFT)


def apart(made):
    """Return how far the path is from the truth on the second pass, rms, m."""
    off = made._path()[-30:, :2] - TRUTH[-30:, :2]
    return float(np.sqrt((off**2).sum(1).mean()))


def test_many_particles_close_a_loop_that_one_does_not():
    """Without wide kernel or heavy tails, so that no particle is pulled from afar to its place."""
    rng, errors = np.random.default_rng(1), {}
    felt = motions(TRUTH, rng=rng)
    scans = [scanned(RING, pose, noise=0.01, rng=rng) for pose in TRUTH]
    frames = [keyframe(k, *row) for k, row in enumerate(zip(felt, scans, strict=True))]
    for particles in (1, 30):
        made = begun(particles=particles, wide=0.08, dof=np.inf)
        driven(made, frames)
        errors[particles] = apart(made)
    assert errors[1] > 0.5
    assert errors[30] < 0.15


def test_by_default_the_ends_meet_and_the_path_is_revised(frames):
    made = begun()
    revisions = driven(made, frames)
    poses = np.full((len(frames), 3), np.nan)
    for k, revision in enumerate(revisions):
        assert revision.ids[-1] == k
        poses[revision.ids] = revision.poses
    np.testing.assert_array_equal(poses, made._path())  # what was told is what is kept
    assert any(len(revision.ids) > 1 for revision in revisions)
    assert apart(made) < 0.15
    assert made.counts()["resamplings"] > 0
    walls = [mark for mark in made.landmarks() if mark.kind == "wall"]
    assert walls == []  # the drive has no observations


def test_without_scans_particles_spread_as_the_motion_does():
    made = begun(particles=4000)
    P, pose = np.zeros((3, 3)), TRUTH[0].copy()
    d = np.array([0.3, 0.0, 0.15])
    for k in range(8):
        revision = made.add(keyframe(k, d))
        c, s = np.cos(pose[2]), np.sin(pose[2])
        F = np.array([[1, 0, -s * d[0] - c * d[1]], [0, 1, c * d[0] - s * d[1]], [0, 0, 1]])
        V = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        P = F @ P @ F.T + V @ np.diag(SIGMA**2) @ V.T
        pose = compose(pose, d)
    np.testing.assert_allclose(wrapped(revision.poses[0] - pose, 2), 0.0, atol=1e-12)
    sigmas = np.sqrt(np.diag(P))
    assert np.abs((revision.covariances[0] - P) / np.outer(sigmas, sigmas)).max() < 0.08


def test_a_scan_in_a_known_map_determines_the_motion():
    """Where points are many and do not share errors, the scan outweighs a motion that is 2 cm off."""
    scan, spreads = scanned(RING, TRUTH[0]), []
    known_map = {"insertion_distance": 0.0, "correlated_points": 1.0}
    for how in (known_map, {}):  # by default, no scan is in the map yet
        made = begun(particles=50, **how)
        for k, d_pose in enumerate(([0.0, 0.0, 0.0], [0.02, -0.015, 0.004])):
            made.add(keyframe(k, np.array(d_pose), scan))
        first, second = made._drawn.array
        spreads.append(np.trace(np.cov((second - first)[:, :2].T)))
        if how:  # particle 0 is not drawn, but at the optimum
            assert np.abs(wrapped(second[0] - TRUTH[0], 2)).max() < 3e-3
    assert spreads[0] < 0.8 * spreads[1]


def test_ancestors_and_lineages_of_particles():
    parents = np.array([[0, 1, 2], [1, 1, 2], [0, 2, 2]])
    np.testing.assert_array_equal(lineage(parents, 0), [1, 0, 0])
    np.testing.assert_array_equal(lineage(parents, 2), [2, 2, 2])
    np.testing.assert_array_equal(ancestors(parents, np.array([0, 1, 2]), 1), [0, 2, 2])
    np.testing.assert_array_equal(ancestors(parents, np.array([0, 1, 2]), 2), [1, 2, 2])


def test_the_seed_determines_the_samples(frames):
    paths = []
    for seed in (0, 0, 1):
        made = begun(seed=seed, particles=5)
        driven(made, frames[:60])
        paths.append(made._poses.copy())
    np.testing.assert_array_equal(paths[0], paths[1])
    assert np.abs(paths[0] - paths[2]).max() > 1e-4
