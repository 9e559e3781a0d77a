"""The local map: look-up equals brute force, normals are those of the walls, the past is forgotten."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from impslam.geometry.se2 import rotation
from impslam.tracking.local_map import REACH, LocalMap, nearest, normals

METRES = st.floats(-20.0, 20.0, allow_subnormal=False)
LIMIT = 0.5


def points(longest=40):
    return st.integers(0, longest).flatmap(lambda n: arrays(np.float64, (n, 2), elements=METRES))


def surfaces(places, cell=0.25):
    """All points, however near to each other, in cells."""
    known = LocalMap(cell, 1e-12, 1.0)
    n = len(places)
    known.add(np.asarray(places, float).reshape(-1, 2), np.zeros((n, 2)), np.zeros(n, bool), 0.0)
    return known.surfaces


def assert_nearest(x, y, limit, known):
    """The point found is as near as brute force's; the interpreter checks the bounds."""
    found = nearest(x, y, limit, known)
    assert found == nearest.py_func(x, y, limit, known)  # IndexError beyond an array's end
    apart = np.hypot(known.points[:, 0] - x, known.points[:, 1] - y)
    least = apart.min(initial=math.inf)
    if found >= 0:
        assert apart[found] == pytest.approx(least, abs=1e-12)
        assert apart[found] < limit + 1e-12
    else:
        assert least > limit - 1e-9


@settings(max_examples=100, deadline=None)
@given(points(), METRES, METRES, st.floats(0.01, 10.0), st.floats(0.1, 3.0))
def test_nearest_equals_brute_force(places, x, y, limit, cell):
    assert_nearest(x, y, limit, surfaces(places, cell))


@settings(max_examples=50, deadline=None)
@given(points(), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_points_far_outside_have_no_partner_and_stay_in_bounds(places, x, y):
    assert_nearest(x, y, LIMIT, surfaces(places))


def test_nearest_in_a_crowd(rng):
    """Many points to a cell, asked from inside, from the border and from beyond all four sides."""
    known = surfaces(rng.uniform(-3.0, -1.0, (500, 2)))
    for x, y in rng.uniform(-4.0, 0.0, (300, 2)):
        assert_nearest(float(x), float(y), LIMIT, known)
    for x, y in known.points[:50]:
        assert known.points[nearest(x, y, LIMIT, known)].tolist() == [x, y]


def test_an_empty_map_has_no_nearest():
    known = surfaces([])
    for x, y in ((0.0, 0.0), (-3.0, 2.0), (1e6, -1e6)):
        assert_nearest(x, y, LIMIT, known)
        assert nearest(x, y, LIMIT, known) == -1


def test_every_point_is_in_its_cell_once(rng):
    known = surfaces(rng.uniform(-5.0, 5.0, (200, 2)))
    assert sorted(known.order) == list(range(200))
    assert len(known.starts) == known.nx * known.ny + 1
    for cell in range(known.nx * known.ny):
        inside = known.points[known.order[known.starts[cell] : known.starts[cell + 1]]]
        expected = np.floor((inside - known.origin) / known.cell)
        np.testing.assert_array_equal(expected, np.tile(divmod(cell, known.ny), (len(inside), 1)))


# --------------------------------------------------------------------------- normals


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
    assert np.abs(directions[REACH:-REACH, 0]).max() < 4 * 0.002 / (0.02 * math.sqrt(28))


def test_a_corner_is_no_surface_and_its_sides_are():
    steps = np.arange(20, 0, -1)[:, None] * 0.05
    corner = np.vstack((steps * [1.0, 0.0], np.zeros((1, 2)), steps[::-1] * [0.0, 1.0]))
    directions, flat = normals(corner, 0.1)
    assert not flat[20]
    away = np.abs(np.arange(41) - 20) >= REACH
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


def entered(known, places, way):
    n = len(places)
    known.add(np.asarray(places, float), np.tile([1.0, 0.0], (n, 1)), np.ones(n, bool), way)
    return known.surfaces


def test_points_near_to_known_ones_are_not_entered_again():
    known = LocalMap(0.25, 0.05, 6.0)
    entered(known, [[0.0, 0.0], [1.0, 0.0]], 0.0)
    seen = entered(known, [[0.049, 0.0], [1.051, 0.0]], 1.0)
    np.testing.assert_array_equal(seen.points, [[0.0, 0.0], [1.0, 0.0], [1.051, 0.0]])


def test_points_are_forgotten_after_the_memory():
    known = LocalMap(0.25, 0.05, 6.0)
    entered(known, [[0.0, 0.0]], 0.0)
    assert len(entered(known, [[1.0, 0.0]], 3.0).points) == 2
    assert len(entered(known, [[2.0, 0.0]], 5.9).points) == 3
    left = entered(known, [[3.0, 0.0]], 6.0)
    np.testing.assert_array_equal(left.points[:, 0], [1.0, 2.0, 3.0])
    assert len(left.normals) == len(left.flat) == len(left.order) == 3
    assert entered(known, np.empty((0, 2)), 100.0).points.shape == (0, 2)
