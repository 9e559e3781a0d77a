"""Cylinders as jumps of the range, filtered (thesis 4.1.2, 5.2.1)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.extractors.scans import cast, people, regular_angles, room, with_ranges

from impslam.extractors.filtered_jump import FilteredJump
from impslam.extractors.jump import Jump
from impslam.extractors.readings import rms_off_line
from impslam.types import Array

WALLS = room(-2.0, 3.0, -2.5, 2.5)
RADIUS = 0.1524


def circle(x: float, y: float, radius: float = RADIUS) -> Array:
    return np.array([[x, y, radius]])


def panel(distance: float, width: float) -> Array:
    """Return a room with a flat piece of wall of this width across the view."""
    flat = np.array([[[distance, -width / 2.0], [distance, width / 2.0]]])
    return np.concatenate((WALLS, flat))


@pytest.mark.parametrize("distance", [0.9, 1.2, 1.6, 2.0, 2.5])
def test_finds_the_known_cylinder(distance: float, rng: np.random.Generator) -> None:
    scene = cast(WALLS, circle(distance, 0.1))
    (seen,) = FilteredJump().extract(scene.scan, rng)
    assert np.hypot(*(seen.z - scene.circles[0, :2])) < 0.02


@pytest.mark.parametrize("distance", [0.8, 1.2, 1.6])
def test_finds_it_in_the_noise_of_the_lidar(distance: float) -> None:
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(50):
        scene = cast(WALLS, circle(distance, 0.1), noise=0.01, rng=rng)
        seen = FilteredJump().extract(scene.scan, rng)
        found += any(np.hypot(*(o.z - scene.circles[0, :2])) < 0.06 for o in seen)
    assert found >= 40


def test_misses_a_cylinder_too_near_to_show_its_curve(rng: np.random.Generator) -> None:
    scan = cast(WALLS, circle(0.5, 0.0)).scan
    assert FilteredJump().extract(scan, rng) == []
    assert len(FilteredJump(curvature=0.07).extract(scan, rng)) == 1


def test_ideal_cylinder_is_eleven_percent_curved() -> None:
    y = np.linspace(-1.0, 1.0, 100_001)
    points = np.column_stack((np.sqrt(1.0 - y**2), y))
    assert rms_off_line(points) / 2.0 == pytest.approx(np.sqrt(2 / 3 - np.pi**2 / 16) / 2, abs=1e-4)


def test_rejects_a_flat_piece_of_the_right_width(rng: np.random.Generator) -> None:
    scan = cast(panel(1.2, 0.3)).scan
    assert len(FilteredJump(curvature=0.0).extract(scan, rng)) == 1
    assert FilteredJump().extract(scan, rng) == []
    noisy = cast(panel(1.2, 0.3), noise=0.01, rng=rng).scan
    assert FilteredJump().extract(noisy, rng) == []


@pytest.mark.parametrize("radius", [0.08, 0.25])
def test_rejects_another_width(radius: float, rng: np.random.Generator) -> None:
    scan = cast(WALLS, circle(1.2, 0.0, radius)).scan
    assert FilteredJump().extract(scan, rng) == []
    assert len(FilteredJump(radius=radius).extract(scan, rng)) == 1
    assert len(FilteredJump(narrowest=0.0, widest=9.0).extract(scan, rng)) == 1


def test_rejects_fewer_points_than_eleven(rng: np.random.Generator) -> None:
    loose = {"curvature": 0.0, "narrowest": 0.0, "widest": 9.0}
    for beams in range(60, 200, 10):
        scan = cast(WALLS, circle(1.2, 0.01), angles=regular_angles(beams, np.pi)).scan
        (candidate,) = FilteredJump(threshold=10.0, min_points=2, **loose).extract(scan, rng)
        kept = FilteredJump(threshold=10.0, **loose).extract(scan, rng)
        assert len(kept) == (len(candidate.beams) >= 11)


def test_shows_fewer_spurious_cylinders_than_plain_jumps() -> None:
    rng = np.random.default_rng(7)
    counts = np.zeros(2, int)
    for _ in range(30):
        scan = cast(WALLS, people(rng, 6), noise=0.01, rng=rng).scan
        counts += [
            len(e.extract(scan, rng)) for e in (Jump(threshold=15.0), FilteredJump(radius=0.3))
        ]
    assert counts[1] < 0.2 * counts[0]


def test_all_invalid_gives_nothing(rng: np.random.Generator) -> None:
    scan = cast(WALLS).scan
    assert FilteredJump().extract(with_ranges(scan, np.zeros(682)), rng) == []


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=60, max_size=60))
def test_never_fails_whatever_the_ranges(ranges: list[float]) -> None:
    scan = cast(WALLS, angles=regular_angles(60, np.pi)).scan
    extractor = FilteredJump(threshold=1.0, min_points=2, narrowest=0.0, widest=1e9, curvature=0.0)
    for seen in extractor.extract(with_ranges(scan, np.array(ranges)), np.random.default_rng(0)):
        assert np.all(np.isfinite(seen.z))
        assert np.linalg.eigvalsh(seen.R)[0] > 0.0
