"""Walls by RANSAC (thesis Algorithm 1)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.extractors.scans import Scene, cast, people, regular_angles, room, with_ranges

from impslam.extractors.ransac import Ransac, associate
from impslam.geometry.angles import wrap
from impslam.types import Array, Observation

WALLS = room(-2.0, 3.0, -2.5, 2.5)
CLEAN = Ransac(distance=1e-6)  # m: only a line along one wall gathers readings


def nearest_wall(scene: Scene, seen: Observation) -> tuple[int, Array]:
    """Return the true wall most like the observation, and [rho, alpha] off it."""
    off = np.column_stack(
        (seen.z[0] - scene.walls[:, 0], [wrap(float(seen.z[1] - a)) for a in scene.walls[:, 1]])
    )
    wall = int(np.argmin(np.abs(off).sum(axis=1)))
    return wall, off[wall]


@pytest.mark.parametrize("laser", [np.zeros(3), np.array([0.3, -0.2, 2.0])])
@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("heading", [0.0, 1.1, 3.0])
def test_walls_without_noise_are_exact(laser: Array, upside_down: bool, heading: float) -> None:
    scene = cast(WALLS, pose=np.array([0.4, 0.3, heading]), laser=laser, upside_down=upside_down)
    walls = CLEAN.extract(scene.scan, np.random.default_rng(2))
    found = []
    for seen in walls:
        wall, off = nearest_wall(scene, seen)
        found.append(wall)
        assert np.abs(off).max() < 1e-9
        assert set(scene.beams_on_wall(wall)) <= set(seen.beams)
    assert sorted(found) == [w for w in range(4) if len(scene.beams_on_wall(w)) > CLEAN.consensus]
    assert [seen.beams[0] for seen in walls] == sorted(seen.beams[0] for seen in walls)


def test_end_points_are_the_outermost_readings_in_beam_order() -> None:
    for upside_down in (False, True):
        scene = cast(WALLS, upside_down=upside_down)
        for seen in CLEAN.extract(scene.scan, np.random.default_rng(0)):
            assert seen.end_points is not None
            first_and_last = scene.scan.points[seen.beams[[0, -1]]]
            np.testing.assert_allclose(seen.end_points, first_and_last, atol=1e-9)


def test_normal_points_away_from_the_laser_even_behind_base_link() -> None:
    # The laser looks back from 1 m ahead at a wall 0.5 m ahead of base_link.
    wall = np.array([[[0.5, -1.0], [0.5, 1.0]]])
    scan = cast(wall, laser=np.array([1.0, 0.0, np.pi])).scan
    (seen,) = Ransac().extract(scan, np.random.default_rng(0))
    assert seen.z[0] == pytest.approx(-0.5)
    assert abs(seen.z[1]) == pytest.approx(np.pi)
    assert np.cos(seen.z[1]) * 1.0 < seen.z[0]


def test_same_state_of_the_generator_same_walls() -> None:
    scan = cast(WALLS, noise=0.01).scan
    first, second = (Ransac().extract(scan, np.random.default_rng(5)) for _ in range(2))
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.z, b.z)
        np.testing.assert_array_equal(a.beams, b.beams)


def test_readings_are_removed_so_each_belongs_to_one_wall() -> None:
    scan = cast(WALLS, noise=0.01).scan
    beams = np.concatenate([o.beams for o in Ransac().extract(scan, np.random.default_rng(1))])
    assert len(np.unique(beams)) == len(beams)


def test_noise_of_the_lidar_gives_walls_within_its_covariance() -> None:
    rng, squared = np.random.default_rng(11), []
    for _ in range(100):
        scene = cast(room(-1.5, 2.0, -1.5, 1.5), noise=0.01, rng=rng)
        for seen in Ransac(consensus=100).extract(scene.scan, rng):
            _, off = nearest_wall(scene, seen)
            if abs(off[1]) < 0.1:  # spurious ones are the next test's
                squared.append(off**2 / np.diag(seen.R))
    assert len(squared) > 150
    assert np.mean(squared) < 1.0


def test_spurious_walls_exist_as_in_the_thesis() -> None:
    rng, spurious, total = np.random.default_rng(4), 0, 0
    for _ in range(100):
        scene = cast(WALLS, people(rng, 6), noise=0.01, rng=rng)
        for seen in Ransac().extract(scene.scan, rng):
            _, off = nearest_wall(scene, seen)
            spurious += bool(abs(off[0]) > 0.2 or abs(off[1]) > 0.2)
            total += 1
    assert 0 < spurious < 0.5 * total


def test_consensus_must_be_exceeded() -> None:
    scene = cast(np.array([[[1.0, -0.5], [1.0, 0.5]]]))
    n = len(scene.beams_on_wall(0))
    for consensus, walls in ((n, 0), (n - 1, 1)):
        seen = Ransac(consensus=consensus).extract(scene.scan, np.random.default_rng(0))
        assert len(seen) == walls


def test_samples_come_from_within_d_degrees() -> None:
    # Two clusters, far apart in angle: with a small D no line joins them, with a large one some do.
    angles = np.concatenate((np.linspace(0.0, 0.1, 20), np.linspace(1.5, 1.6, 20)))
    points = np.column_stack((np.cos(angles), np.sin(angles)))
    dice = np.random.default_rng(0).random((50, 4))
    near = associate(points, angles, dice, 0.2, 0.01, 15)
    assert near.max() == 1
    assert all(len(set(near[k : k + 20])) == 1 for k in (0, 20))
    nothing = associate(points, angles, dice, 1e-4, 0.01, 15)
    assert nothing.max() == -1


def test_angles_wrap_at_the_seam_of_a_full_turn() -> None:
    # The only wall straddles the seam; half of it alone has too few readings within D.
    scene = cast(np.array([[[-1.0, -0.4], [-1.0, 0.4]]]), angles=regular_angles(360, 2.0 * np.pi))
    extractor = Ransac(samples=30, degrees=20.0, consensus=40)
    assert len(extractor.extract(scene.scan, np.random.default_rng(0))) == 1


def test_covariance_is_the_square_of_the_deviations() -> None:
    seen = Ransac(sigma_rho=0.1, sigma_alpha=0.3).extract(
        cast(WALLS).scan, np.random.default_rng(0)
    )
    np.testing.assert_allclose(seen[0].R, np.diag([0.01, 0.09]))


@pytest.mark.parametrize("beams", [0, 1, 2, 30])
def test_too_few_beams_give_nothing(beams: int, rng: np.random.Generator) -> None:
    scan = cast(WALLS, angles=regular_angles(beams, np.pi)).scan
    assert Ransac().extract(scan, rng) == []
    assert Ransac().extract(with_ranges(scan, np.zeros(beams)), rng) == []


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=60, max_size=60))
def test_never_fails_whatever_the_ranges(ranges: list[float]) -> None:
    scan = with_ranges(cast(WALLS, angles=regular_angles(60, np.pi)).scan, np.array(ranges))
    for seen in Ransac(consensus=3, samples=2).extract(scan, np.random.default_rng(0)):
        assert np.all(np.isfinite(seen.z))
        assert np.all(scan.valid[seen.beams])
        assert np.linalg.eigvalsh(seen.R)[0] > 0.0
