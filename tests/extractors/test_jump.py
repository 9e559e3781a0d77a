"""Cylinders as jumps of the range (thesis 4.1.2)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.extractors.scans import URG_ANGLES, cast, regular_angles, room, with_ranges

from impslam.extractors.jump import Jump, candidates, derivative
from impslam.types import Array, Scan

WALLS = room(-2.0, 3.0, -2.5, 2.5)
RADIUS = 0.1524
STEP = URG_ANGLES[1] - URG_ANGLES[0]
MOUNTS = [np.zeros(3), np.array([0.2, -0.1, 0.7]), np.array([-0.3, 0.0, np.pi])]


def at(*centres: tuple[float, float]) -> Array:
    return np.array([[*centre, RADIUS] for centre in centres])


@pytest.mark.parametrize("laser", MOUNTS)
@pytest.mark.parametrize("upside_down", [False, True])
def test_finds_bearing_and_place_of_a_cylinder(
    laser: Array, upside_down: bool, rng: np.random.Generator
) -> None:
    pose = np.array([0.3, -0.2, 0.4])
    ahead = laser[2] + pose[2]
    circles = at((0.3 + 1.4 * np.cos(ahead), -0.2 + 1.4 * np.sin(ahead)))
    scene = cast(WALLS, circles, pose=pose, laser=laser, upside_down=upside_down)
    (seen,) = Jump().extract(scene.scan, rng)
    truth = scene.circles[0, :2]
    to_truth, to_seen = truth - laser[:2], seen.z - laser[:2]
    bearing = np.arctan2(*to_seen[::-1]) - np.arctan2(*to_truth[::-1])
    # Each edge lies up to one step beyond the last beam that meets the cylinder.
    assert abs(np.angle(np.exp(1j * bearing))) <= STEP / 2.0
    assert np.hypot(*to_seen) == pytest.approx(np.hypot(*to_truth), abs=1e-3)
    assert seen.kind == "cylinder"
    np.testing.assert_array_equal(seen.beams, scene.beams_on_circle(0))


def test_moving_the_whole_scene_moves_nothing_in_base_link(rng: np.random.Generator) -> None:
    first = Jump().extract(cast(WALLS, at((1.0, 0.5), (0.5, -1.0))).scan, rng)
    turned = Jump().extract(
        cast(WALLS, at((1.0, 0.5), (0.5, -1.0)), laser=np.array([0.0, 0.0, 0.3])).scan, rng
    )
    assert len(first) == len(turned) == 2
    for a, b in zip(first, turned, strict=True):
        assert np.hypot(*(a.z - b.z)) < 1.5 * STEP * np.hypot(*a.z)


def test_covariance_is_the_polar_one_turned_into_the_beam(rng: np.random.Generator) -> None:
    scene = cast(WALLS, at((1.0, 1.0)))
    (seen,) = Jump(sigma_range=0.05, sigma_bearing=0.01).extract(scene.scan, rng)
    r = np.hypot(*seen.z)
    beam = seen.z / r
    across = np.array([-beam[1], beam[0]])
    assert beam @ seen.R @ beam == pytest.approx(0.05**2)
    assert across @ seen.R @ across == pytest.approx((0.01 * r) ** 2)
    assert beam @ seen.R @ across == pytest.approx(0.0, abs=1e-12)


def test_a_gap_without_return_breaks_the_data_as_in_the_thesis(
    rng: np.random.Generator,
) -> None:
    scan = cast(WALLS, at((1.0, 0.0))).scan
    assert len(Jump().extract(scan, rng)) == 1
    # Nothing behind the cylinder returns: it is missed, and the gap makes no cylinder.
    alone = cast(WALLS, at((1.0, 0.0)), range_max=1.3).scan
    assert Jump().extract(alone, rng) == []


def test_a_second_fall_restarts_and_a_lone_rise_is_ignored() -> None:
    slope = np.array([0.0, 9.0, -9.0, 0.0, -9.0, 0.0, 0.0, 9.0, 9.0])
    assert candidates(slope, 5.0) == [(5, 7)]


def test_derivative_does_not_depend_on_the_direction_of_rotation() -> None:
    angles, ranges = np.array([0.0, 0.1, 0.1, 0.3]), np.array([1.0, 2.0, 4.0, 3.0])
    np.testing.assert_allclose(derivative(angles, ranges), [10.0, 0.0, -5.0])
    np.testing.assert_allclose(derivative(-angles, ranges), [10.0, 0.0, -5.0])


@pytest.mark.parametrize("beams", [0, 1, 2, 181, 720])
def test_any_number_of_beams(beams: int, rng: np.random.Generator) -> None:
    scene = cast(WALLS, at((1.0, 0.0)), angles=regular_angles(beams, np.pi))
    assert len(Jump().extract(scene.scan, rng)) == (1 if beams > 100 else 0)


def test_all_invalid_gives_nothing(rng: np.random.Generator) -> None:
    scan = cast(WALLS).scan
    assert Jump().extract(with_ranges(scan, np.zeros(682)), rng) == []
    assert Jump().extract(with_ranges(scan, np.full(682, np.nan)), rng) == []


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=60, max_size=60))
def test_never_fails_and_never_uses_an_invalid_beam(ranges: list[float]) -> None:
    scan: Scan = cast(WALLS, angles=regular_angles(60, np.pi)).scan
    for seen in Jump(threshold=1.0).extract(
        with_ranges(scan, np.array(ranges)), np.random.default_rng(0)
    ):
        assert np.all(np.isfinite(seen.z))
        assert np.linalg.eigvalsh(seen.R)[0] > 0.0
