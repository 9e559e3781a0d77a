"""The local map: look-up equals brute force, normals are those of the walls, the past is forgotten."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from impslam.geometry.se2 import rotation
from impslam.tracking.local_map import CAPACITY, add, empty_map, nearest, size
from impslam.tracking.surfels import MIN_NEIGHBOURS, _prepare, thin

METRES = st.floats(-20.0, 20.0, allow_subnormal=False)
LIMIT = 0.5


def points(longest=40):
    return st.integers(0, longest).flatmap(lambda n: arrays(np.float64, (n, 2), elements=METRES))


def rows_of(places):
    """Return points (n, 2) as rows of `Surfels`, on a surface with its normal along x."""
    places = np.asarray(places, float).reshape(-1, 2)
    return np.column_stack([places, np.tile([1.0, 0.0, 1.0, 1.0], (len(places), 1))])


def surfaces(places):
    """All points, however near to each other, in cells."""
    local_map = empty_map()
    add(local_map, rows_of(places), 1e-12, 1.0)
    return local_map


def look_up(x, y, limit, local_map, hint=-1):
    """Return the row of the nearest known point."""
    return nearest(x, y, limit, hint, local_map.rows, local_map.older, local_map.cells)


def held(local_map):
    """Return the points (n, 2) in the order in which they came."""
    return local_map.rows[np.arange(*local_map.ring) % CAPACITY, :2]


def assert_nearest(x, y, limit, local_map, hint=-1):
    """The point found is as near as brute force's; the interpreter checks the bounds."""
    found = look_up(x, y, limit, local_map, hint)
    apart = np.hypot(*(held(local_map) - [x, y]).T)
    least = apart.min(initial=math.inf)
    if found >= 0:
        assert apart[found] == pytest.approx(least, abs=1e-12)
        assert apart[found] < limit + 1e-12
    else:
        assert least > limit - 1e-9


@settings(max_examples=100, deadline=None)
@given(points(), METRES, METRES, st.floats(0.01, 10.0), st.integers(-1, 39))
def test_nearest_equals_brute_force_whatever_the_hint(places, x, y, limit, hint):
    local_map = surfaces(places)
    assert_nearest(x, y, limit, local_map, min(hint, size(local_map) - 1))


@settings(max_examples=50, deadline=None)
@given(points(), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_points_far_outside_have_no_partner_and_stay_in_bounds(places, x, y):
    assert_nearest(x, y, LIMIT, surfaces(places))


@pytest.mark.parametrize("x", [np.nan, np.inf, -np.inf, 1e300])
def test_what_is_no_place_has_no_nearest(x):
    local_map = surfaces([[0.0, 0.0]])
    assert look_up(x, 0.0, LIMIT, local_map, -1) == look_up(x, 0.0, LIMIT, local_map, 0) == -1


def test_nearest_in_a_crowd(rng):
    """Many points to a cell, asked from inside, from the border and from beyond all four sides."""
    local_map = surfaces(rng.uniform(-3.0, -1.0, (500, 2)))
    for x, y in rng.uniform(-4.0, 0.0, (300, 2)):
        assert_nearest(float(x), float(y), LIMIT, local_map)
    for x, y in held(local_map)[:50]:
        assert local_map.rows[look_up(x, y, LIMIT, local_map, -1), :2].tolist() == [x, y]


def test_places_that_share_a_cell_are_told_apart():
    """Cells repeat every 32 m."""
    places = [[0.1, 0.1], [32.1, 0.1], [0.1, -31.9], [32.1, 64.1]]
    local_map = surfaces(places)
    for k, (x, y) in enumerate(places):
        assert look_up(x, y, LIMIT, local_map, -1) == k


def test_an_empty_map_has_no_nearest():
    local_map = surfaces([])
    for x, y in ((0.0, 0.0), (-3.0, 2.0), (1e6, -1e6)):
        assert look_up(x, y, LIMIT, local_map, -1) == -1


# --------------------------------------------------------------------------- normals


def normals(points, gap):
    """Return unit normals (n, 2) of points in beam order, and which lie on a straight surface."""
    n, rows = len(points), np.empty((len(points), 6))
    valid, gaps = np.ones((1, n), np.bool_), np.array([gap])
    points = np.ascontiguousarray(points, float)[None]
    assert _prepare(points, valid, gaps, 0.0, rows, np.zeros(2, np.int64)) == n
    np.testing.assert_array_equal(rows[:, :2], points[0])
    return rows[:, 2:4], rows[:, 4] > 0.0


@pytest.mark.parametrize("angle", np.linspace(-3.0, 3.0, 7))
def test_normals_stand_on_a_straight_wall(angle):
    along = np.column_stack((np.linspace(-1.0, 1.0, 41), np.full(41, 0.7)))
    directions, flat = normals(along @ rotation(angle).T, 0.1)
    assert flat.all()
    np.testing.assert_allclose(np.abs(directions @ rotation(angle)[:, 1]), 1.0, atol=1e-12)


def test_normals_of_a_noisy_wall_are_units_within_its_noise(rng):
    wall = np.column_stack((np.linspace(0.0, 2.0, 101), 0.002 * rng.standard_normal(101)))
    directions, flat = normals(wall, 0.1)
    assert flat.all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    assert np.abs(directions[MIN_NEIGHBOURS:-MIN_NEIGHBOURS, 0]).max() < 4 * 0.002 / (
        0.02 * math.sqrt(28)
    )


def test_a_corner_is_no_surface_and_its_sides_are():
    steps = np.arange(20, 0, -1)[:, None] * 0.05
    corner = np.vstack((steps * [1.0, 0.0], np.zeros((1, 2)), steps[::-1] * [0.0, 1.0]))
    directions, flat = normals(corner, 0.1)
    assert not flat[20]
    away = np.abs(np.arange(41) - 20) >= MIN_NEIGHBOURS
    assert flat[away].all()
    np.testing.assert_allclose(np.abs(directions[:18, 1]), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(directions[23:, 0]), 1.0, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_lone_post_is_no_surface(count):
    """Up to three beams: even on a line they have too few neighbours."""
    _, flat = normals(0.01 * np.arange(count)[:, None] * np.ones(2), 0.1)
    assert flat.shape == (count,)
    assert not flat.any()


def test_surfaces_end_where_the_points_jump():
    """A post before a wall takes no neighbour from it."""
    wall = np.column_stack((np.full(21, 3.0), np.linspace(-1.0, 1.0, 21)))
    scan = np.vstack((wall[:10], [[1.0, 0.0], [1.0, 0.02]], wall[11:]))
    directions, flat = normals(scan, 0.15)
    assert not flat[10:12].any()
    assert flat[:10].all()
    assert flat[12:].all()
    np.testing.assert_allclose(np.abs(directions[[*range(10), *range(12, 22)], 0]), 1.0, atol=1e-12)


# --------------------------------------------------------------------------- memory


def entered(local_map, places, travelled):
    local_map.travelled[0] = travelled
    add(local_map, rows_of(places), 0.05, 6.0)
    return held(local_map)


def test_points_near_to_known_ones_are_not_entered_again():
    local_map = empty_map()
    entered(local_map, [[0.0, 0.0], [1.0, 0.0]], 0.0)
    seen = entered(local_map, [[0.049, 0.0], [1.051, 0.0]], 1.0)
    np.testing.assert_array_equal(seen, [[0.0, 0.0], [1.0, 0.0], [1.051, 0.0]])


def test_points_are_forgotten_after_the_memory():
    local_map = empty_map()
    entered(local_map, [[0.0, 0.0], [0.1, 0.0]], 0.0)
    assert len(entered(local_map, [[1.0, 0.0]], 3.0)) == 3
    assert len(entered(local_map, [[2.0, 0.0]], 5.9)) == 4
    left = entered(local_map, [[3.0, 0.0]], 6.0)
    np.testing.assert_array_equal(left[:, 0], [1.0, 2.0, 3.0])
    assert look_up(0.0, 0.0, LIMIT, local_map, -1) == -1
    assert entered(local_map, np.empty((0, 2)), 100.0).shape == (0, 2)


def test_what_is_left_after_forgetting_is_found(rng):
    """Cells hold points of all ages; the chains of the ring's second lap are as good."""
    local_map = empty_map()
    for lap in range(60):
        left = entered(local_map, rng.uniform(-20.0, 20.0, (1000, 2)), 0.2 * lap)
        assert size(local_map) <= CAPACITY
    assert local_map.ring[1] > CAPACITY
    for k in range(0, len(left), 97):
        row = look_up(*left[k], LIMIT, local_map, -1)
        np.testing.assert_array_equal(local_map.rows[row, :2], left[k])


def test_a_full_map_forgets_the_oldest():
    local_map = empty_map()
    places = np.column_stack([0.1 * np.arange(CAPACITY + 10), np.zeros(CAPACITY + 10)])
    assert len(entered(local_map, places, 0.0)) == CAPACITY
    np.testing.assert_array_equal(held(local_map), places[10:])
    assert look_up(0.0, 0.0, 0.09, local_map, -1) == -1


def test_points_stand_in_the_frame_of_the_map():
    local_map = empty_map()
    local_map.pose[:] = 1.0, 2.0, math.pi / 2
    np.testing.assert_allclose(entered(local_map, [[3.0, 0.5]], 0.0), [[0.5, 5.0]])
    np.testing.assert_allclose(local_map.rows[0, 2:4], [0.0, 1.0], atol=1e-15)


def test_thinning_keeps_points_apart_and_on_request_surfaces_only():
    rows = rows_of(np.column_stack([0.03 * np.arange(10), np.zeros(10)]))
    rows[3, 5] = 0.0
    assert thin(rows, 0.05, False)[:, 0] == pytest.approx([0.0, 0.06, 0.12, 0.18, 0.24])
    assert thin(rows[2:5], 0.01, True)[:, 0] == pytest.approx([0.06, 0.12])
