import numpy as np
import pytest
from tests.rooms import FRONT, MOUNTS, drive, scans_at

from impslam.errors import ShapeError
from impslam.geometry import se2
from impslam.surfaces.rematch import TooLargeError, rematch, surface_map_of


@pytest.mark.parametrize("mount", MOUNTS)
def test_scans_find_back_into_the_map(mount):
    keyframes = drive()
    known_scans = scans_at(keyframes, MOUNTS[mount])
    known = surface_map_of(keyframes, known_scans.features, known_scans.starts)
    truth = se2.compose(keyframes, np.array([0.15, 0.04, 0.1]))
    scans = scans_at(truth, MOUNTS[mount])
    noise = np.random.default_rng(4).uniform(-1, 1, truth.shape) * [0.04, 0.04, 0.015]
    done = rematch(known, truth + noise, scans.features, scans.starts)
    error = np.abs(se2.between(truth, done.poses))
    assert (np.median(error, 0) < [1e-3, 1e-3, 5e-4]).all()
    assert (error.max(0) < [0.02, 0.02, 0.01]).all()
    assert done.shares.min() > 0.8


def test_a_scan_without_features_keeps_its_pose_and_says_how_little_is_known():
    keyframes = drive()[:10]
    scans = scans_at(keyframes)
    known = surface_map_of(keyframes, scans.features, scans.starts)
    done = rematch(known, keyframes[:1], scans.features, np.zeros(2, np.int64))
    assert done.poses.tobytes() == keyframes[:1].tobytes()
    assert done.shares[0] == 0.0
    np.testing.assert_allclose(done.covariances[0], np.diag([0.05**2, 0.05**2, 0.02**2]))


def test_a_scan_off_the_map_keeps_its_pose():
    keyframes = drive()[:10]
    scans = scans_at(keyframes)
    known = surface_map_of(keyframes, scans.features, scans.starts)
    away = keyframes + np.array([200.0, 0.0, 0.0])
    done = rematch(known, away, scans.features, scans.starts)
    np.testing.assert_array_equal(done.poses, away)
    assert (done.shares == 0.0).all()


def test_covariances_cover_the_errors_of_noise():
    keyframes = drive()[:30]
    rng = np.random.default_rng(6)
    size = (len(keyframes), FRONT.beams)
    clean = scans_at(keyframes)
    known = surface_map_of(keyframes, clean.features, clean.starts)
    chi2 = []
    for _ in range(5):
        scans = scans_at(keyframes, noise=rng.normal(0, 0.03, size))
        done = rematch(known, keyframes, scans.features, scans.starts)
        e = done.poses - keyframes
        chi2.append(np.einsum("ka,kab,kb->k", e, np.linalg.inv(done.covariances), e))
    assert 0.3 < np.mean(chi2) < 3.0


def test_runs_are_the_same_to_the_byte():
    keyframes = drive()[:20]
    scans = scans_at(keyframes)
    first, second = (
        rematch(
            surface_map_of(keyframes, scans.features, scans.starts),
            keyframes + 0.01, scans.features, scans.starts,
        )
        for _ in range(2)
    )  # fmt: skip
    for a, b in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_map_too_large_is_refused():
    keyframes = np.array([[0.0, 0.0, 0.0], [4000.0, 3000.0, 0.0]])
    scans = scans_at(drive()[:2])
    with pytest.raises(TooLargeError, match=r"40\d\d x 30\d\d m is too large"):
        surface_map_of(keyframes, scans.features, scans.starts)


def test_no_keyframes_make_an_empty_map():
    known = surface_map_of(np.empty((0, 3)), np.empty((0, 5), np.float32), np.zeros(1, np.int64))
    scans = scans_at(drive()[:2])
    done = rematch(known, drive()[:2], scans.features, scans.starts)
    np.testing.assert_array_equal(done.poses, drive()[:2])


def test_scans_that_are_not_all_there_are_refused():
    keyframes = drive()[:3]
    scans = scans_at(keyframes)
    with pytest.raises(ShapeError, match="starts has shape"):
        surface_map_of(keyframes[:2], scans.features, scans.starts)
    known = surface_map_of(keyframes, scans.features, scans.starts)
    with pytest.raises(ShapeError, match="do not rise"):
        rematch(known, keyframes, scans.features[:-1], scans.starts)
