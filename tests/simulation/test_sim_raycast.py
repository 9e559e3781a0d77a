"""Ray casting against closed forms."""

import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.simulation.raycast import trace

NO_SEGMENTS, NO_CIRCLES = np.empty((0, 4)), np.empty((0, 3))
STILL = (np.empty((2, 0, 4)), np.empty((2, 0, 3)))

angle = st.floats(-math.pi, math.pi)
near = st.floats(-2.0, 2.0)


def cast(pose, angles, segments=NO_SEGMENTS, circles=NO_CIRCLES, reach=100.0):
    n = len(angles)
    lasers = np.tile(np.asarray(pose, float), (n, 1))
    standing = (np.asarray(segments, float), np.asarray(circles, float))
    return trace(lasers, np.asarray(angles, float), np.zeros(n), standing, STILL, reach)[:2]


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    """Compile before hypothesis measures how long an example takes."""
    cast([0, 0, 0], [0.0])


@given(near, near, angle, st.floats(0.1, 5.0), angle)
def test_long_wall_is_met_at_distance_over_cosine(x, y, heading, gap, normal):
    n, along = (
        np.array([math.cos(normal), math.sin(normal)]),
        np.array([-math.sin(normal), math.cos(normal)]),
    )
    foot = np.array([x, y]) + gap * n
    wall = np.hstack([foot - 1e3 * along, foot + 1e3 * along])[None]
    offsets = np.linspace(-1.4, 1.4, 15)
    ranges, cosines = cast([x, y, heading], normal - heading + offsets, wall)
    np.testing.assert_allclose(ranges, gap / np.cos(offsets), rtol=1e-9)
    np.testing.assert_allclose(cosines, np.cos(offsets), atol=1e-9)


@given(near, near, angle, st.floats(0.05, 1.0), st.floats(0.1, 5.0), angle)
def test_circle_is_met_by_the_cosine_rule(x, y, heading, radius, gap, bearing):
    d = radius + gap
    centre = [x + d * math.cos(bearing), y + d * math.sin(bearing)]
    half = math.asin(radius / d)
    offsets = np.array([-0.99, -0.5, 0.0, 0.5, 0.99]) * half
    ranges, cosines = cast(
        [x, y, heading], bearing - heading + offsets, circles=[[*centre, radius]]
    )
    across = d * np.sin(offsets)
    expected = d * np.cos(offsets) - np.sqrt(radius**2 - across**2)
    np.testing.assert_allclose(ranges, expected, rtol=1e-7)
    np.testing.assert_allclose(cosines, np.sqrt(1 - (across / radius) ** 2), atol=1e-6)
    missed, none = cast(
        [x, y, heading],
        bearing - heading + np.array([-1.01, 1.01]) * half,
        circles=[[*centre, radius]],
    )
    assert np.isinf(missed).all()
    assert (none == 0).all()


@given(st.floats(0.0, 0.9), angle, angle)
def test_circle_is_met_from_inside(part, bearing, direction):
    place = part * np.array([math.cos(bearing), math.sin(bearing)])
    (hit,), _ = cast([*place, 0.0], [direction], circles=[[0.0, 0.0, 1.0]])
    end = place + hit * np.array([math.cos(direction), math.sin(direction)])
    assert math.hypot(*end) == pytest.approx(1.0)


def test_rays_miss_beside_and_behind_a_segment():
    wall = [[2.0, -1.0, 2.0, 1.0]]
    edge = math.atan2(1.0, 2.0)
    ranges, _ = cast([0, 0, 0], [edge - 1e-6, edge + 1e-6, math.pi], wall)
    assert ranges[0] == pytest.approx(math.sqrt(5.0), abs=1e-5)
    assert np.isinf(ranges[1:]).all()


def test_parallel_ray_misses():
    assert np.isinf(cast([0, 0, 0], [0.0], [[1.0, 0.5, 2.0, 0.5]])[0]).all()


def test_the_nearest_hit_within_the_maximum_range_counts():
    walls = [[3.0, -1, 3.0, 1], [2.0, -1, 2.0, 1], [4.0, -1, 4.0, 1]]
    circles = [[1.5, 0.0, 0.25]]
    assert cast([0, 0, 0], [0.0], walls)[0] == pytest.approx(2.0)
    assert cast([0, 0, 0], [0.0], walls, circles)[0] == pytest.approx(1.25)
    assert np.isinf(cast([0, 0, 0], [0.0], walls, reach=1.9)[0]).all()


def test_moving_objects_are_hit_at_the_beams_time():
    fractions = np.linspace(0.0, 1.0, 11)
    lasers, angles = np.zeros((11, 3)), np.zeros(11)
    wall = np.array([[[2.0, -1, 2.0, 1]], [[3.0, -1, 3.0, 1]]])
    leg = np.array([[[5.0, 0.0, 0.5]], [[1.0, 0.0, 0.5]]])
    ranges, *_ = trace(lasers, angles, fractions, (NO_SEGMENTS, NO_CIRCLES), (wall, leg), 50.0)
    np.testing.assert_allclose(ranges, np.minimum(2.0 + fractions, 4.5 - 4.0 * fractions))


def test_sweep_is_fast():
    rng = np.random.default_rng(1)
    starts = rng.uniform(-5, 5, (200, 2))
    walls = np.hstack([starts, starts + rng.normal(size=(200, 2))])
    angles = np.linspace(-2.1, 2.1, 682)
    best = math.inf
    for _ in range(20):
        begin = time.perf_counter()
        cast([0, 0, 0], angles, walls)
        best = min(best, time.perf_counter() - begin)
    # 0.5 ms where it was written; the margin is for slow and busy machines.
    assert best < 5e-3
