"""Features of scans: normals towards the lidar, weights by what lies beside a point, thinning."""

import math

import numpy as np
import pytest
from tests.extractors.scans import cast, room, with_ranges
from tests.rooms import MOUNTS, Mount, features_at

from impslam.surfaces.features import (
    Sampling,
    beam_spacing,
    features,
    find_features,
    leave_out_oblique,
)

ROOM = room(-2.0, 3.0, -1.5, 2.2)
LASERS = [(0.0, 0.0, 0.0), (0.4, 0.2, 1.0), (-0.3, -0.25, math.pi)]


def nearest_wall(rows, walls):
    """Return the inner normal (n, 2) of the wall that each point lies on, and the distance to it."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    normals = np.column_stack((-along[:, 1], along[:, 0])) / np.hypot(*along.T)[:, None]
    off = np.einsum("wk,nwk->nw", normals, rows[:, None, :2] - start)
    k = np.abs(off).argmin(1)
    return normals[k], np.abs(off)[np.arange(len(rows)), k]


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("laser", LASERS)
def test_normals_are_perpendicular_to_walls_and_point_to_the_lidar(laser, upside_down):
    laser = np.array(laser)
    rows = features(cast(ROOM, laser=laser, upside_down=upside_down).scan, 0.04)
    surfaces = rows[rows[:, 4] > 0]
    normals, off = nearest_wall(surfaces, ROOM)
    assert off.max() < 1e-6
    agree = np.einsum("nk,nk->n", surfaces[:, 2:4], normals)
    assert np.median(agree) > 1.0 - 1e-6
    assert np.mean(agree > 0.999) > 0.9  # the others lie in corners
    assert agree.min() > 0.0
    towards = np.einsum("nk,nk->n", surfaces[:, 2:4], laser[:2] - surfaces[:, :2])
    assert towards.min() > 0.0


@pytest.mark.parametrize("mount", MOUNTS)
def test_normals_are_units_however_the_lidar_is_mounted(mount):
    rows = features_at((3.0, 1.0, 0.7), MOUNTS[mount])
    surfaces = rows[rows[:, 4] > 0]
    assert len(surfaces) > 0.7 * len(rows)
    np.testing.assert_allclose(np.hypot(*surfaces[:, 2:4].T), 1.0, atol=1e-6)


def test_upside_down_and_upright_lidars_see_the_same():
    """Beams in the other order are the same points; thinning begins from the other end."""
    up = features_at((3.0, 1.0, 0.7), Mount((0.2, 0.05, 0.1), -1.5, 1.5, 361), thin=0.0)
    down = features_at((3.0, 1.0, 0.7), Mount((0.2, 0.05, 0.1), -1.5, 1.5, 361, -1.0), thin=0.0)
    np.testing.assert_allclose(down[::-1], up, atol=1e-4)


def test_normals_of_a_noisy_wall_are_within_its_noise(rng):
    """1 cm on 17 points over 0.5 m at most: 4 sigma of a line through them is 0.05 rad."""
    wall = np.array([[[4.0, -3.0], [4.0, 3.0]]])
    rows = features(cast(wall, noise=0.01, rng=rng).scan, 0.04)
    inner = rows[(rows[:, 4] == 1.0) & (np.abs(rows[:, 1]) < 1.5)]
    assert len(inner) > 20
    assert np.abs(inner[:, 3]).max() < 4.0 * 0.01 / (0.25 / math.sqrt(3) * math.sqrt(13))
    assert inner[:, 2].max() < -0.99


def wall_ahead(gaps=(), beams=61):
    """A wall 1 m ahead, 0.5 m to each side, by regular beams; some of them see nothing."""
    angles = np.linspace(-0.46, 0.46, beams)
    scan = cast(np.array([[[1.0, -2.0], [1.0, 2.0]]]), angles=angles).scan
    valid = np.ones(beams, bool)
    valid[list(gaps)] = False
    return with_ranges(scan, scan.ranges, valid)


def test_a_wall_counts_fully_inside_and_half_at_its_ends():
    weights = features(wall_ahead(), 0.0)[:, 4]
    assert weights[[0, -1]].tolist() == [0.5, 0.5]
    assert (weights[1:-1] == 1.0).all()


def test_the_feature_before_an_end_is_that_end_on_both_sides():
    """Beams are kept from right to left, so the last one kept may be up to 4 cm from the left end."""
    wall = np.array([[[1.5, -0.5], [1.5, 0.5]]])
    for beams in range(601, 631, 3):
        weights = features(cast(wall, angles=np.linspace(-0.3, 0.3, beams)).scan, 0.04)[:, 4]
        assert weights[[0, -1]].tolist() == [0.5, 0.5]
        assert (weights[2:-2] == 1.0).all()


def test_a_gap_makes_two_ends():
    rows = features(wall_ahead(range(25, 35)), 0.0)
    assert len(rows) == 51
    assert np.flatnonzero(rows[:, 4] == 0.5).tolist() == [0, 24, 25, 50]


@pytest.mark.parametrize("lone", [1, 2])
def test_a_point_with_fewer_than_two_neighbours_is_on_no_surface(lone):
    gaps = [k for k in range(61) if not 30 <= k < 30 + lone]
    assert (features(wall_ahead(gaps), 0.0)[:, 4] == 0.0).all()


def test_a_post_before_a_wall_takes_no_neighbours_from_it():
    scan = cast(np.array([[[3.0, -2.0], [3.0, 2.0]]]), np.array([[1.5, 0.0, 0.005]])).scan
    rows = features(scan, 0.0)
    post = rows[:, 0] < 2.0
    assert 1 <= post.sum() <= 2
    assert (rows[post, 4] == 0.0).all()
    surfaces = rows[rows[:, 4] > 0]
    np.testing.assert_allclose(
        surfaces[:, 2:4], np.tile([-1.0, 0.0], (len(surfaces), 1)), atol=1e-3
    )


def test_a_corner_is_no_surface_and_its_sides_are():
    rows = features(cast(ROOM).scan, 0.0)
    apart = np.hypot(*(rows[:, :2] - np.array([3.0, 2.2])).T)
    assert (rows[apart < 0.03, 4] == 0.0).all()
    assert (rows[(apart > 0.3) & (apart < 0.6), 4] > 0.0).all()


def test_grazing_beams_give_no_normal():
    """Beyond 83 degrees of incidence."""
    rows = features(cast(np.array([[[-0.5, 0.2], [5.0, 0.2]]])).scan, 0.0)
    cosine = 0.2 / np.hypot(rows[:, 0], rows[:, 1])
    assert (cosine < 0.119).any()
    assert (rows[cosine < 0.119, 4] == 0.0).all()
    assert (rows[cosine > 0.3, 4] > 0.0).all()


def test_features_of_grazing_beams_can_be_left_out():
    """All others keep their order: surfaces and a post."""
    wall = np.array([[[-0.5, 0.2], [5.0, 0.2]], [[-0.5, 0.2], [-0.5, -2.0]]])
    rows = features(cast(wall, np.array([[1.5, -0.8, 0.01]])).scan, 0.0)
    grazing = (rows[:, 4] == 0.0) & rows[:, 2:4].any(1)
    assert grazing.any()
    assert (0.2 / np.hypot(*rows[grazing, :2].T) < 0.121).all()
    assert ((rows[:, 4] == 0.0) & ~grazing).any()  # the post
    kept = rows.copy()
    np.testing.assert_array_equal(kept[: leave_out_oblique(kept)], rows[~grazing])


def test_sparse_beams_along_a_wall_are_no_posts():
    """Beams of 1 degree meet a wall 1 m aside every 0.4 m at 5 m: the points go where the robot goes."""
    angles = np.radians(np.arange(-90.0, 91.0))
    wall = np.array([[[-30.0, 1.0], [30.0, 1.0]]])
    rows = features(cast(wall, angles=angles, range_max=30.0).scan, 0.0)
    kept = rows[: leave_out_oblique(rows)]
    assert (kept[:, 4] > 0.0).all()
    assert len(kept) > 60
    post = np.array([[3.0, 0.0, 0.02]])
    rows = features(cast(wall, post, angles=angles, range_max=30.0).scan, 0.0)
    kept = rows[: leave_out_oblique(rows)]
    lone = kept[kept[:, 4] == 0.0]
    np.testing.assert_allclose(lone[:, :2], [[2.98, 0.0]], atol=1e-3)


@pytest.mark.parametrize("thin", [0.0, 0.04, 0.2])
def test_thinning_keeps_points_apart_and_leaves_normals_as_they_are(thin):
    scan = cast(ROOM).scan
    every, kept = features(scan, 0.0), features(scan, thin)
    apart = np.hypot(*np.diff(kept[:, :2], axis=0).T)
    cosine = (kept[1:, 2:4] * kept[:-1, 2:4]).sum(1)
    one_wall = cosine > 0.99  # around a corner, the chord is shorter
    nearest = 1.5  # m; over `thin` the spacing of beams on a wall changes by less than this share
    assert apart[one_wall].min() >= thin * (1.0 - thin / nearest) - 1e-6
    everywhere = {row[:4].tobytes() for row in every}
    assert all(row[:4].tobytes() in everywhere for row in kept)
    if thin == 0.0:
        assert len(kept) == scan.valid.sum()


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_thinning_does_not_turn_a_noisy_wall(rng, noise):
    """The points that are kept are no farther than the wall on the left, and no nearer on the right."""
    angles, wall = np.radians(np.linspace(-30.0, 30.0, 601)), np.array([[[1.5, -4.0], [1.5, 4.0]]])
    slopes = []
    for _ in range(200):
        kept = features(cast(wall, angles=angles, noise=noise, rng=rng).scan, 0.04)
        slopes.append(np.polyfit(kept[:, 1], kept[:, 0], 1)[0])
    assert abs(np.mean(slopes)) < 4.0 * np.std(slopes) / math.sqrt(len(slopes))


def test_invalid_beams_have_no_features():
    scan = cast(ROOM).scan
    assert features(with_ranges(scan, np.zeros(len(scan.ranges))), 0.04).shape == (0, 5)
    assert features(cast(ROOM, angles=np.empty(0)).scan, 0.04).shape == (0, 5)


def test_a_turn_of_everything_turns_the_features():
    """The lidar's mount turns, its beams do not: points and normals turn about base_link."""
    turn = 0.9
    one = features(cast(ROOM, laser=np.array([0.3, 0.1, 0.2])).scan, 0.04)
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, -s], [s, c]])
    laser = np.array([*(R @ [0.3, 0.1]), 0.2 + turn])
    other = features(cast(ROOM, pose=np.array([0.0, 0.0, -turn]), laser=laser).scan, 0.04)
    np.testing.assert_allclose(other[:, :2], one[:, :2] @ R.T, atol=1e-5)
    np.testing.assert_allclose(other[:, 2:4], one[:, 2:4] @ R.T, atol=1e-4)
    np.testing.assert_array_equal(other[:, 4], one[:, 4])


def test_spacing_is_that_of_the_beams():
    assert beam_spacing(np.linspace(-1.0, 1.0, 201)) == pytest.approx(0.01)
    assert beam_spacing(np.linspace(1.0, -1.0, 201)) == pytest.approx(0.01)
    assert beam_spacing(np.zeros(1)) == 0.0


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.06])
def test_noisy_walls_are_still_surfaces(rng, noise):
    """Only in a scan without noise are points 6 cm off a line a heap of things."""
    rows = features(cast(ROOM, noise=noise, rng=rng).scan, 0.04)
    assert np.mean(rows[:, 4] > 0.0) > 0.8
    normals, _ = nearest_wall(rows[rows[:, 4] > 0.0], ROOM)
    agree = np.einsum("nk,nk->n", rows[rows[:, 4] > 0.0, 2:4], normals)
    assert np.mean(agree > 0.8) > 0.75


def test_normals_of_a_near_wall_do_not_depend_on_the_spacing_of_the_beams(rng):
    """As far as the noise of independent beams allows: those that are closer are not left out."""
    sigmas = []
    for beams in (361, 1441):
        angles = np.radians(np.linspace(-90.0, 90.0, beams))
        scan = cast(np.array([[[1.0, -4.0], [1.0, 4.0]]]), angles=angles, noise=0.01, rng=rng).scan
        near = features(scan, 0.0)
        near = near[(near[:, 4] == 1.0) & (np.abs(near[:, 1]) < 0.5)]
        sigmas.append(near[:, 3].std())
    assert sigmas[0] < 0.03
    assert sigmas[1] < sigmas[0]


@pytest.mark.parametrize(("beams", "known"), [(6, False), (60, True)])
def test_a_piece_of_a_wall_that_is_short_for_the_noise_has_no_weight(rng, beams, known):
    """Beams of 0.35 deg between others that are lost, 1.6 m away: 5 cm of a wall, or 60 cm."""
    angles = np.radians(0.352 * np.arange(-200, 201))
    scan = cast(np.array([[[1.6, -9.0], [1.6, 9.0]]]), angles=angles, noise=0.015, rng=rng).scan
    piece = slice(200, 200 + beams)
    valid = scan.valid.copy()
    valid[piece.start - 15 : piece.start] = valid[piece.stop : piece.stop + 15] = False
    rows = features(with_ranges(scan, scan.ranges, valid), 0.0)
    y = 1.6 * np.tan(angles[piece])
    rows = rows[(rows[:, 1] > y[0] - 0.01) & (rows[:, 1] < y[-1] + 0.01)]
    assert len(rows) >= beams - 2
    assert (rows[1:-1, 4] > 0.0).all() == known


def test_lost_beams_do_not_divide_a_wall(rng):
    scan = cast(ROOM, noise=0.01, rng=rng).scan
    valid = scan.valid & (rng.random(len(scan.ranges)) > 0.3)
    rows = features(with_ranges(scan, scan.ranges, valid), 0.04)
    assert np.mean(rows[:, 4] == 1.0) > 0.9
    normals, off = nearest_wall(rows[rows[:, 4] == 1.0], ROOM)
    agree = np.einsum("nk,nk->n", rows[rows[:, 4] == 1.0, 2:4], normals)
    assert np.quantile(agree[off < 0.05], 0.05) > 0.99


def test_the_noise_of_one_object_is_that_object():
    """Points scattered over 20 cm within a smooth room are no surface."""
    scan = cast(ROOM, angles=np.linspace(-math.pi, math.pi, 720, endpoint=False)).scan
    ranges = scan.ranges.copy()
    ranges[300:330] += np.tile([0.1, -0.1], 15)
    rows = features(with_ranges(scan, ranges), 0.0)
    inside = slice(305, 325)
    assert (rows[inside, 4] == 0.0).all()
    assert np.mean(rows[:, 4] > 0.0) > 0.9


def test_points_at_one_place_have_no_normal():
    points, ranges = np.tile([[3.0, 1.0]], (5, 1)), np.full(5, np.hypot(3.0, 1.0))
    out = np.empty((5, 5), np.float32)
    count = find_features(
        points, ranges > 0.0, ranges, np.zeros((5, 2)), Sampling(0.0, 0.0, smooth=True), out
    )
    np.testing.assert_array_equal(out[:count, 2:], np.zeros((5, 3)))


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_smoothed_points_have_a_quarter_of_the_noise(rng, noise):
    """A line through 17 points; in the middle of them its error is a quarter of theirs."""
    wall = np.array([[[4.0, -3.0], [4.0, 3.0]]])
    off = {True: [], False: []}
    for _ in range(20):
        scan = cast(wall, noise=noise, rng=rng).scan
        for smooth in off:
            rows = features(scan, 0.04, smooth=smooth)
            inner = rows[(rows[:, 4] == 1.0) & (np.abs(rows[:, 1]) < 1.5)]
            off[smooth] += (inner[:, 0] - 4.0).tolist()
    assert np.std(off[False]) == pytest.approx(noise, rel=0.1)
    assert np.std(off[True]) == pytest.approx(0.25 * noise, rel=0.2)
    assert abs(np.mean(off[True])) < 0.1 * noise


def test_smoothing_keeps_the_shape_of_a_column(rng):
    """Its points scatter about a line by more than the noise, so they stay on the circle."""
    column = np.array([[2.0, 0.0, 0.25]])
    angles = np.linspace(-1.5, 1.5, 1001)
    off = []
    for _ in range(20):
        scan = cast(ROOM, column, angles=angles, noise=0.003, rng=rng).scan
        x, y = features(scan, 0.04)[:, :2].T
        apart = np.hypot(x - 2.0, y) - 0.25
        off += apart[np.abs(apart) < 0.05].tolist()
    assert len(off) > 100
    assert abs(np.mean(off)) < 0.005
    assert np.std(off) < 0.01


@pytest.mark.parametrize("growth", [0.0, 0.02])
def test_a_far_wall_is_a_surface_if_the_noise_grows_with_the_range(rng, growth):
    """At 6 m it is then 12 cm. If all of the scan had the noise of the median, it would be a heap."""
    corridor = np.array(
        [[[6.0, -4.0], [6.0, 4.0]], [[0.0, -1.0], [6.0, -1.0]], [[0.0, 1.0], [6.0, 1.0]]]
    )
    scan = cast(corridor, angles=np.linspace(-1.5, 1.5, 1001), range_max=20.0).scan
    sigma = 0.003 + growth * scan.ranges
    noisy = with_ranges(scan, scan.ranges + rng.normal(0.0, sigma), scan.valid)
    rows = features(noisy, 0.04)
    far = rows[(np.abs(rows[:, 0] - 6.0) < 0.3) & (np.abs(rows[:, 1]) < 0.7)]
    assert len(far) > 20
    assert np.mean((far[:, 2] != 0.0) | (far[:, 3] != 0.0)) > 0.9
