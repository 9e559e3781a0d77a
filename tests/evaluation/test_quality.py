"""Map quality without truth: its sensitivities and its invariances."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.estimators.drives import LAP, RING, scanned, way
from tests.extractors.scans import room

from impslam.evaluation.quality import _spaced, quality
from impslam.geometry.se2 import compose
from impslam.map import Keyframes, Map

NOISE = 0.01


def keyframes(plan, truth, noise=NOISE, seed=0, poses=None, every=1):
    """Return the keyframes of a plan seen from true poses (k, 3), placed at `poses`."""
    rng = np.random.default_rng(seed)
    scans = [scanned(plan, pose, noise=noise, rng=rng) for pose in truth]
    points = [scan.points[scan.valid][::every].astype(np.float32) for scan in scans]
    k = len(truth)
    return Keyframes(
        np.arange(float(k)),
        np.array(truth if poses is None else poses),
        np.zeros((k, 3, 3)),
        np.zeros((k, 3)),
        np.zeros((k, 2)),
        np.cumsum([0, *map(len, points)]),
        np.concatenate(points) if k else np.zeros((0, 2), np.float32),
        np.zeros((k, 3)),
        np.zeros((k, 3, 3)),
        np.zeros(k, np.int64),
        np.ones(k, np.bool_),
    )


def made(frames):
    """Return a map of keyframes alone."""
    none = np.zeros((0, 3))
    places = none, np.zeros((0, 6)), none, none, none
    return Map(frames, (), none[:, 0], np.zeros(0, np.int64), *places)


TWICE = np.concatenate([way(*LAP), way(*LAP)[1:]])


@pytest.fixture(scope="module")
def ring():
    return keyframes(RING, TWICE)


def off(frames, shift):
    """Return the keyframes with those of the second lap moved by a shift (3,) in map."""
    poses = frames.poses.copy()
    poses[len(poses) // 2 :] += shift
    return replace(frames, poses=poses)


def test_a_true_map_disagrees_by_the_noise_of_its_points(ring):
    found = quality(made(ring))
    assert found.revisited > 0.9
    assert 0.3 * NOISE < found.within < 1.5 * NOISE
    assert 0.3 * NOISE < found.between < 1.5 * NOISE
    assert NOISE < found.thickness < 2.0 * NOISE
    assert found.contradicted < 0.002
    assert found.doubled < 0.001


def test_it_grows_with_the_error_between_two_passes(ring):
    sizes = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
    found = [quality(made(off(ring, (d, d, 0.0)))) for d in sizes]
    assert (np.diff([f.disagreement for f in found]) > 0.0).all()
    assert np.ptp([f.within for f in found]) < 0.2 * NOISE  # each lap is as it was


def test_a_doubled_wall_is_detected(ring):
    found = quality(made(off(ring, (0.25, 0.25, 0.0))))
    assert found.doubled > 0.1
    assert found.contradicted >= found.doubled
    assert found.thickness < 3.0 * NOISE  # each of the two is thin
    assert 0.2 < found.between < 0.3


def test_errors_within_a_pass_are_measured_without_revisits():
    truth = way(*LAP[:2])
    rng = np.random.default_rng(1)
    shaken = truth + rng.normal(size=truth.shape) * [0.05, 0.05, 0.01]
    good, bad = (quality(made(keyframes(RING, truth, poses=p))) for p in (truth, shaken))
    assert good.revisited == 0.0
    assert math.isnan(good.between)
    assert good.disagreement == good.within
    assert bad.disagreement > 2.0 * good.disagreement


def test_both_sides_of_a_thin_wall_do_not_contradict_each_other():
    rooms = np.concatenate([room(0.0, 12.0, 0.0, 3.0), room(0.0, 12.0, 3.1, 6.0)])
    there, back = way((1.0, 1.5), (11.0, 1.5)), way((11.0, 4.5), (1.0, 4.5))
    found = quality(made(keyframes(rooms, np.concatenate([there, back]))))
    assert found.contradicted < 0.002
    assert found.disagreement < 1.5 * NOISE


def test_how_densely_it_was_driven_and_seen_does_not_matter(ring):
    shift = (0.04, 0.0, 0.0)
    whole = quality(made(off(ring, shift)))
    often = np.repeat(TWICE, 3, axis=0)  # as a robot that stands at each place
    still = quality(made(off(keyframes(RING, often, seed=1), shift)))
    sparse = quality(made(off(keyframes(RING, TWICE, seed=2, every=2), shift)))
    for other in (still, sparse):
        assert other.disagreement == pytest.approx(whole.disagreement, rel=0.1)
        assert other.thickness == pytest.approx(whole.thickness, rel=0.15)


def test_the_frame_of_the_map_does_not_matter(ring):
    moved = replace(ring, poses=compose(np.array([5.2, -3.7, 2.0]), ring.poses))
    assert quality(made(moved)).disagreement == pytest.approx(
        quality(made(ring)).disagreement, rel=0.05
    )


@pytest.mark.parametrize("heading", [0.0, math.pi / 4, 2.0])
def test_keyframes_are_chosen_along_the_path_in_any_frame(ring, heading):
    moved = replace(ring, poses=compose(np.array([0.0, 0.0, heading]), ring.poses))
    np.testing.assert_array_equal(_spaced(moved).origins, _spaced(ring).origins)
    assert len(_spaced(moved).poses) == len(_spaced(ring).poses)


@pytest.mark.parametrize("k", [0, 1])
def test_a_map_without_overlaps_has_no_quality(k):
    found = quality(made(keyframes(RING, TWICE[:k])))
    assert math.isnan(found.disagreement)
    assert math.isnan(found.revisited)


def test_keyframes_without_points_a_place_or_a_finite_pose_are_left_out(ring):
    poses = np.concatenate([ring.poses, ring.poses[:1]])
    poses[5], poses[9] = math.nan, 0.0
    placed = np.ones(len(poses), np.bool_)
    placed[9] = False
    odd = replace(
        ring,
        stamps=np.arange(float(len(poses))),
        poses=poses,
        origins=np.zeros((len(poses), 2)),
        starts=np.append(ring.starts, ring.starts[-1]),
        placed=placed,
    )
    expected = quality(made(ring)).disagreement
    assert quality(made(odd)).disagreement == pytest.approx(expected, rel=0.1)
