"""Walls by the Hough transform (thesis 4.2.4)."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.extractors.scans import Scene, cast, people, regular_angles, room, with_ranges

from impslam.extractors.hough import Hough
from impslam.geometry.angles import wrap
from impslam.types import Array, Observation

WALLS = room(-2.0, 3.0, -2.5, 2.5)
TURN = regular_angles(1024, 2.0 * np.pi)
HALF_BIN = math.radians(5.0)


def nearest_wall(scene: Scene, seen: Observation) -> tuple[int, Array]:
    """Return the true wall most like the observation, and [rho, alpha] off it."""
    off = np.column_stack(
        (seen.z[0] - scene.walls[:, 0], [wrap(float(seen.z[1] - a)) for a in scene.walls[:, 1]])
    )
    wall = int(np.argmin(np.abs(off).sum(axis=1)))
    return wall, off[wall]


@pytest.mark.parametrize("turn", range(36))
@pytest.mark.parametrize("laser", [np.zeros(3), np.array([0.2, -0.1, 0.4])])
def test_walls_in_the_middle_of_a_bin_of_angle(
    turn: int, laser: Array, rng: np.random.Generator
) -> None:
    pose = np.array([0.31, -0.12, math.radians(10.0 * turn)])
    scene = cast(WALLS, pose=pose, laser=laser, angles=TURN)
    seen = Hough().extract(scene.scan, rng)
    assert sorted(nearest_wall(scene, o)[0] for o in seen) == [0, 1, 2, 3]
    for o in seen:
        _, (rho, alpha) = nearest_wall(scene, o)
        assert abs(alpha) < 1e-6
        # Half a bin, and a pixel's diagonal for the rounding of points and of votes.
        assert abs(rho) <= 0.01 + 0.01 * math.sqrt(2.0)


def test_any_other_wall_is_within_half_a_bin_of_angle(rng: np.random.Generator) -> None:
    for _ in range(40):
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)])
        scene = cast(WALLS, pose=pose, angles=TURN)
        seen = Hough(threshold=10).extract(scene.scan, rng)  # at 3 m the beams are 2 cm apart
        assert sorted(nearest_wall(scene, o)[0] for o in seen) == [0, 1, 2, 3]  # none twice
        for o in seen:
            _, (_, alpha) = nearest_wall(scene, o)
            assert abs(alpha) <= HALF_BIN + 0.01


@pytest.mark.parametrize(
    ("size", "resolution", "rho_bin"),
    [(501, 0.02, 0.02), (500, 0.02, 0.04), (999, 0.01, 0.03), (1500, 0.005, 0.02)],
)
def test_other_images(
    size: int, resolution: float, rho_bin: float, rng: np.random.Generator
) -> None:
    scene = cast(WALLS, pose=np.array([0.1, 0.2, math.radians(40.0)]), angles=TURN)
    extractor = Hough(size=size, resolution=resolution, rho_bin=rho_bin)
    seen = extractor.extract(scene.scan, rng)
    assert sorted(nearest_wall(scene, o)[0] for o in seen) == [0, 1, 2, 3]
    for o in seen:
        _, (rho, alpha) = nearest_wall(scene, o)
        assert abs(alpha) < 1e-6
        assert abs(rho) <= 0.5 * rho_bin + resolution * math.sqrt(2.0)


def test_image_mapping_is_that_of_the_thesis_and_its_inverse() -> None:
    extractor = Hough()
    points = np.array([[1.0, 0.0], [0.0, 1.0], [-4.99, 4.99], [1.234, -0.567]])
    pixels = extractor._to_pixels(points)
    T = np.array([[0.0, -1.0, 500.0], [1.0, 0.0, 500.0], [0.0, 0.0, 1.0]])
    by_matrix = (T @ np.column_stack((100.0 * points, np.ones(4))).T).T[:, :2]
    np.testing.assert_array_equal(pixels, np.rint(by_matrix))
    np.testing.assert_allclose(extractor._to_robot(by_matrix), points, atol=1e-12)


def test_every_shape_that_opencv_returns(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    scan = cast(WALLS, angles=TURN).scan
    expected = Hough().extract(scan, rng)
    original = cv2.HoughLines
    for shape in ((-1, 1, 2), (1, -1, 2), (-1, 2)):
        monkeypatch.setattr(cv2, "HoughLines", lambda *a, s=shape: original(*a).reshape(s))
        seen = Hough().extract(scan, rng)
        assert [tuple(o.z) for o in seen] == [tuple(o.z) for o in expected]


def count_with_people(extractor: Hough, headings: Array) -> tuple[int, int]:
    """Return how many lines are no wall, and how many of the 4 walls a scan are missed."""
    rng = np.random.default_rng(8)
    spurious = missed = 0
    for heading in headings:
        pose = np.array([0.0, 0.0, heading])
        scene = cast(WALLS, people(rng, 6), pose=pose, noise=0.01, rng=rng, angles=TURN)
        found = set()
        for seen in extractor.extract(scene.scan, rng):
            wall, off = nearest_wall(scene, seen)
            if abs(off[0]) < 0.2 and abs(off[1]) < 0.15:
                found.add(wall)
            else:
                spurious += 1
        missed += 4 - len(found)
    return spurious, missed


def test_robust_with_people_about() -> None:
    # 60 scans of 4 walls in the middle of their bins of angle, where the transform is at its best.
    spurious, missed = count_with_people(Hough(threshold=40), np.radians(10.0 * np.arange(60)))
    assert spurious <= 3
    assert missed <= 12


def test_at_any_heading_people_cost_the_default_some_walls_but_not_most() -> None:
    headings = np.random.default_rng(1).uniform(-np.pi, np.pi, 60)
    spurious, missed = count_with_people(Hough(), headings)
    assert spurious < 0.3 * 240
    assert missed < 0.3 * 240


def test_errors_agree_with_the_covariance() -> None:
    rng, squared = np.random.default_rng(9), []
    for _ in range(100):
        pose = np.array([*rng.uniform(-0.8, 0.8, 2), rng.uniform(-np.pi, np.pi)])
        scene = cast(WALLS, pose=pose, noise=0.01, rng=rng)
        for seen in Hough().extract(scene.scan, rng):
            _, off = nearest_wall(scene, seen)
            squared.append(off**2 / np.diag(seen.R))
    rho, alpha = np.mean(squared, axis=0)
    assert 0.05 < rho < 1.5
    assert 0.5 < alpha < 1.5


def test_a_line_rests_on_its_own_beams(rng: np.random.Generator) -> None:
    scene = cast(WALLS, angles=TURN)
    for seen in Hough().extract(scene.scan, rng):
        wall, _ = nearest_wall(scene, seen)
        on_wall = np.isin(seen.beams, scene.beams_on_wall(wall))
        assert on_wall.mean() > 0.8
        assert seen.end_points is not None
        n = np.array([np.cos(seen.z[1]), np.sin(seen.z[1])])
        np.testing.assert_allclose(seen.end_points @ n, seen.z[0], atol=1e-9)


def test_points_outside_the_image_are_left_out(rng: np.random.Generator) -> None:
    scene = cast(WALLS, angles=TURN)
    seen = Hough(size=450).extract(scene.scan, rng)  # 2.25 m each way: only the wall at -2 m
    assert [nearest_wall(scene, o)[0] for o in seen] == [2]


@pytest.mark.parametrize("beams", [0, 1, 15])
def test_too_few_beams_give_nothing(beams: int, rng: np.random.Generator) -> None:
    scan = cast(WALLS, angles=regular_angles(beams, np.pi)).scan
    assert Hough().extract(scan, rng) == []
    assert Hough().extract(with_ranges(scan, np.full(beams, np.nan)), rng) == []


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=60, max_size=60))
def test_never_fails_whatever_the_ranges(ranges: list[float]) -> None:
    scan = with_ranges(cast(WALLS, angles=regular_angles(60, np.pi)).scan, np.array(ranges))
    for seen in Hough(threshold=2).extract(scan, np.random.default_rng(0)):
        assert np.all(np.isfinite(seen.z))
        assert np.all(scan.valid[seen.beams])
        assert np.linalg.eigvalsh(seen.R)[0] > 0.0


def test_far_points_do_not_overflow_the_image(rng: np.random.Generator) -> None:
    scan = cast(WALLS, range_max=1e300).scan
    far = with_ranges(scan, np.full(682, 1e300))
    assert far.valid.all()
    assert Hough().extract(far, rng) == []
