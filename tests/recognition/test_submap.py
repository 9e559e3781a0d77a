"""Keyframes are gathered in one frame, thinned, with the free space that they saw."""

import math

import numpy as np
import pytest
from tests.extractors.scans import ORIGIN, cast, regular_angles, room, with_ranges
from tests.recognition.plans import OFFICE, way

from impslam.geometry.se2 import between, compose, transform
from impslam.recognition.free_ranges import BEARINGS
from impslam.recognition.submap import gather, view

SQUARE = room(-2.0, 3.0, -1.5, 2.2)
HALF = regular_angles(181, math.pi)


def test_one_feature_in_each_cell_and_none_lost():
    poses = way(-6.0, -0.3, 5.0, -0.2, 12)
    views = [view(cast(OFFICE, pose=pose).scan) for pose in poses]
    frame = np.array([1.0, 2.0, 0.7])
    submap = gather(views, poses, frame, 0.1)
    cells = np.floor(submap.features[:, :2].astype(float) / 0.1)
    assert len(np.unique(cells, axis=0)) >= 0.999 * len(cells)  # float32 on a cell's border
    everything = np.concatenate([
        transform(between(frame, pose), v.features[:, :2]) for v, pose in zip(views, poses, strict=True)
    ])  # fmt: skip
    assert len(np.unique(np.floor(everything / 0.1), axis=0)) == len(cells)


def test_features_and_normals_are_those_of_the_world(rng):
    pose, frame = rng.normal(size=3), rng.normal(size=3)
    v = view(cast(SQUARE, pose=pose * [0.2, 0.2, 1.0]).scan)
    pose = pose * [0.2, 0.2, 1.0]
    found = gather([v], pose[None], frame, 1e-4).features
    points = transform(between(frame, pose), v.features[:, :2])
    turn = np.array([0.0, 0.0, between(frame, pose)[2]])
    np.testing.assert_allclose(found[:, :2], points, atol=1e-5)
    np.testing.assert_allclose(found[:, 2:4], transform(turn, v.features[:, 2:4]), atol=1e-5)
    np.testing.assert_array_equal(found[:, 4], v.features[:, 4])


def test_nothing_beyond_the_maximum_range():
    v = view(cast(SQUARE).scan)
    near = gather([v], ORIGIN[None], ORIGIN, 0.05, 2.1).features
    assert 0 < len(near) < len(v.features)
    assert np.hypot(near[:, 0], near[:, 1]).max() <= 2.1


@pytest.mark.parametrize("degrees", [57, 180, 270])
def test_share_of_the_directions_that_the_scans_see(degrees):
    """The robot's turns do not widen the view of a scan."""
    angles = regular_angles(4 * degrees, math.radians(degrees))
    poses = np.array([[0.0, 0.0, 0.4 * k] for k in range(5)])
    views = [view(cast(SQUARE, pose=pose, angles=angles).scan) for pose in poses]
    share = gather(views, poses, ORIGIN, 0.05).view_share
    assert share == pytest.approx(degrees / 360.0, abs=2.0 / BEARINGS)


def test_vantages_are_where_the_lidar_was(rng):
    laser, pose, frame = np.array([0.3, 0.1, 0.4]), rng.normal(size=3), rng.normal(size=3)
    v = view(cast(SQUARE, laser=laser).scan)
    (vantage,) = gather([v], pose[None], frame, 0.05).vantages
    expected = compose(between(frame, pose), np.array([0.3, 0.1, 0.0]))
    np.testing.assert_allclose(vantage, expected)


def test_free_space_reaches_to_the_nearest_surface_of_each_bearing():
    laser = np.array([0.3, 0.1, 0.4])
    scan = cast(SQUARE, laser=laser).scan
    free = view(scan).free
    bearings = scan.directions[scan.valid]
    bins = ((bearings + math.pi) / (2.0 * math.pi) * BEARINGS).astype(int) % BEARINGS
    for b in range(BEARINGS):
        inside = scan.ranges[scan.valid][bins == b]
        if len(inside):
            assert np.isclose(free[b], inside.min(), atol=1e-5)
        else:
            assert free[b] == 0.0


def test_a_beam_without_an_echo_has_no_effect():
    open_ahead = cast(SQUARE[1:], angles=HALF, range_max=5.0).scan
    assert not open_ahead.valid.all()
    free = view(open_ahead).free
    ahead = BEARINGS // 2
    assert free[ahead] == free[ahead - 1] == 0.0
    assert free[3 * BEARINGS // 4 - 1] > 0.0


def test_a_few_lost_beams_hide_nothing(rng):
    """With 30 % of them lost, two of three bins of 2 degrees would miss one of their beams."""
    scan = cast(SQUARE, angles=regular_angles(720, 2.0 * math.pi)).scan
    some = with_ranges(scan, np.where(rng.random(720) < 0.3, np.nan, scan.ranges))
    whole, left = view(scan).free, view(some).free
    known = left > 0.0
    assert known.mean() > 0.9  # four in a row are lost at 0.8 % of the beams
    np.testing.assert_allclose(left[known], whole[known], rtol=0.05)


def test_many_lost_beams_in_a_row_hide_everything():
    scan = cast(SQUARE, angles=regular_angles(720, 2.0 * math.pi)).scan
    ranges = scan.ranges.copy()
    ranges[360:384] = np.nan  # 12 degrees from straight ahead
    free = view(with_ranges(scan, ranges)).free
    assert (free[BEARINGS // 2 : BEARINGS // 2 + 5] == 0.0).all()
    assert np.count_nonzero(free == 0.0) <= 7


@pytest.mark.parametrize(("spacing", "share"), [(4.0, 1.0), (8.0, 1.0), (20.0, 0.1)])
def test_between_the_beams_of_a_coarse_lidar_space_is_free(spacing, share):
    """Up to the nearer one of two neighbours, unless they are too far apart."""
    scan = cast(SQUARE, angles=regular_angles(round(360.0 / spacing), 2.0 * math.pi)).scan
    free = view(scan).free
    assert np.mean(free > 0.0) == pytest.approx(share, abs=0.01)
    fine = view(cast(SQUARE, angles=regular_angles(3600, 2.0 * math.pi)).scan).free
    assert (free < 1.25 * fine).all()
