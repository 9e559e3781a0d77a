"""Split and merge: complete walls with consistent covariances, and nothing else."""

import dataclasses

import numpy as np
import pytest
from tests.extractors.scans import URG_ANGLES, cast, regular_angles, room

from impslam.extractors.split_merge import SplitMerge

ROOM = room(-2.0, 2.5, -1.5, 1.8)
WALL = np.array([[[2.0, -1.0], [2.0, 1.5]]])
LASER = np.array([0.145, 0.02, 0.1])
POSE = np.array([0.3, -0.2, 0.4])


def walls(scan, rng, **parameters):
    return SplitMerge(**parameters).extract(scan, rng)


def error(observation, truth):
    """[rho, alpha] observed minus the nearest true wall's, and its index."""
    d = observation.z - truth
    d[:, 1] = (d[:, 1] + np.pi) % (2 * np.pi) - np.pi
    k = int(np.argmin(np.abs(d).sum(1)))
    return d[k], k


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("angles", [URG_ANGLES, URG_ANGLES[::-1], regular_angles(361, np.pi)])
def test_noiseless_room_is_exact_in_any_beam_order(rng, angles, upside_down):
    scene = cast(ROOM, pose=POSE, laser=LASER, angles=angles, upside_down=upside_down, sigma=0.003)
    found = walls(scene.scan, rng)
    visible = [k for k in range(4) if len(scene.beams_on_wall(k)) > 20]
    matched = set()
    for o in found:
        d, k = error(o, scene.walls)
        np.testing.assert_allclose(d, 0.0, atol=5e-4)  # a beam of the corner's other wall
        matched.add(k)
        on_wall = scene.beams_on_wall(k)
        assert len(np.setdiff1d(o.beams, on_wall)) <= 1
        assert len(o.beams) >= len(on_wall) - 3
        normal = [np.cos(o.z[1]), np.sin(o.z[1])]
        np.testing.assert_allclose(o.end_points @ normal, o.z[0], atol=1e-9)
        np.testing.assert_allclose(o.end_points[0], scene.scan.points[o.beams[0]], atol=5e-3)
    assert matched >= set(visible)
    assert len(found) == len(matched)


@pytest.mark.parametrize("start", [0.0, 0.7, np.pi / 2, 3.0])
def test_full_turn_has_each_wall_once_wherever_it_starts(rng, start):
    angles = start + np.arange(360) * np.radians(1.0)
    scene = cast(ROOM, pose=POSE, angles=angles, noise=0.01, rng=rng)
    found = walls(scene.scan, rng)
    assert sorted(error(o, scene.walls)[1] for o in found) == [0, 1, 2, 3]


def test_lost_beams_do_not_break_a_wall(rng):
    scene = cast(WALL, noise=0.01, rng=rng)
    valid = scene.scan.valid.copy()
    on = scene.beams_on_wall(0)
    valid[on[20:23]] = valid[on[50:60]] = False
    valid[on[::7]] = False
    found = walls(dataclasses.replace(scene.scan, valid=valid), rng)
    assert len(found) == 1
    assert np.all(valid[found[0].beams])


def test_wall_behind_a_post_is_one_and_with_a_door_two(rng):
    post = cast(WALL, np.array([[1.0, 0.1, 0.05]]), noise=0.01, rng=rng)
    assert len(walls(post.scan, rng)) == 1
    two = np.array(
        [[[2.0, -1.5], [2.0, -0.4]], [[2.0, 0.4], [2.0, 1.5]], [[4.0, -3.0], [4.0, 3.0]]]
    )
    door = cast(two, noise=0.01, rng=rng)
    found = walls(door.scan, rng)
    assert sum(abs(o.z[0] - 2.0) < 0.1 for o in found) == 2


def test_normal_points_away_from_the_laser_even_if_the_base_is_behind(rng):
    laser = np.array([0.5, 0.0, np.pi])
    scene = cast(np.array([[[0.2, -1.0], [0.2, 1.0]]]), laser=laser)
    (wall,) = walls(scene.scan, rng)
    np.testing.assert_allclose(np.cos(wall.z[1]), -1.0, atol=1e-9)
    assert wall.z[0] == pytest.approx(-0.2, abs=1e-9)


@pytest.mark.parametrize("circle", [(1.0, 0.0, 0.15), (2.0, 0.3, 0.15), (0.6, 0.0, 0.055)])
def test_cylinders_are_no_walls(rng, circle):
    scene = cast(np.empty((0, 2, 2)), np.array([circle]), noise=0.005, sigma=0.005, rng=rng)
    assert walls(scene.scan, rng) == []


def test_short_pieces_and_empty_scans_are_no_walls(rng):
    short = cast(np.array([[[1.0, -0.15], [1.0, 0.2]]]))
    assert walls(short.scan, rng) == []
    assert len(walls(short.scan, rng, min_length=0.3)) == 1
    for n in (0, 1, 2, 3):
        valid = np.zeros(len(URG_ANGLES), bool)
        valid[np.flatnonzero(short.scan.valid)[:n]] = True
        assert walls(dataclasses.replace(short.scan, valid=valid), rng) == []


ASKEW = np.array([[[1.0, -1.0], [2.2, 1.5]]])


def longer(scan, by):
    """The scan with all ranges longer, by a number or by (n,) m."""
    beams = np.column_stack((np.cos(scan.directions), np.sin(scan.directions)))
    by = np.broadcast_to(by, scan.ranges.shape)
    return dataclasses.replace(scan, points=scan.points + by[:, None] * beams)


def test_covariance_is_consistent(rng):
    scene = cast(ASKEW, laser=LASER, sigma=0.01)
    d2 = []
    for _ in range(300):
        noisy = longer(scene.scan, 0.01 * rng.standard_normal(len(scene.scan.ranges)))
        (o,) = walls(noisy, rng, flatness=1e-4)
        d, _ = error(o, scene.walls)
        d2.append(d @ np.linalg.solve(o.R, d))
    # Mean of 300 chi-square values of 2 degrees of freedom: 2 +- 0.115; chi2 > n only widens R.
    assert 1.5 < np.mean(d2) < 2.35


def test_covariance_contains_the_error_common_to_all_ranges(rng):
    scan = cast(ASKEW, laser=LASER, sigma=0.01).scan
    (here,) = walls(scan, rng)
    (far,), (near,) = walls(longer(scan, 1e-4), rng), walls(longer(scan, -1e-4), rng)
    slope = (far.z - near.z) / 2e-4
    (shared,) = walls(dataclasses.replace(scan, bias=0.02), rng)
    np.testing.assert_allclose(
        shared.R - here.R, 0.02**2 * np.outer(slope, slope), rtol=0.01, atol=1e-9
    )


def test_covariance_has_the_floor_of_a_wall_that_is_not_flat(rng):
    scan = cast(WALL, sigma=1e-4).scan
    (o,) = walls(scan, rng, flatness=0.005)
    middle = o.end_points.mean(0)
    arm = np.array([-np.sin(o.z[1]), np.cos(o.z[1])]) @ middle
    about = np.array([[1.0, -arm], [0.0, 1.0]]) @ o.R @ np.array([[1.0, -arm], [0.0, 1.0]]).T
    assert np.sqrt(about[0, 0]) == pytest.approx(0.005 / np.sqrt(2.0), rel=0.1)
    assert np.sqrt(about[1, 1]) == pytest.approx(0.005 * np.sqrt(2.0) / 2.5, rel=0.1)
