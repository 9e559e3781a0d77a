"""Motions of a lidar by its scans: exact without noise, consistent with noise, no scan used twice."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.extractors.scans import cast, room, with_ranges
from tests.numeric import jacobian
from tests.recorded import perfect

from impslam.calibration.lidar_path import LidarPath, lidar_path, twists
from impslam.calibration.recording import first_lidar, record_batches
from impslam.calibration.scan_pairs import _misfit, align, match_pairs, nearest, pairs, surface
from impslam.columns import batches
from impslam.config import load
from impslam.evaluation.trajectory import interpolate
from impslam.geometry.se2 import between, compose
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.world import load_world
from impslam.surfaces.features import features
from impslam.tracking.scan_to_map import ScanToMap
from impslam.types import LaserScan

ROOM = room(-2.0, 3.0, -1.5, 2.2)
CIRCLES = np.array([[1.5, 0.9, 0.2], [-1.0, -0.6, 0.15]])
MOTION = np.array([0.28, 0.05, 0.2])
NOISE = (0.005, 0.0)


def seen(pose, noise=0.0, rng=None, offset=0.0, walls=None):
    """Return the surface seen by a lidar at a pose in the room, or between walls; ranges have an offset."""
    world = (ROOM, CIRCLES) if walls is None else (walls,)
    scan = cast(*world, pose=np.array(pose), noise=noise, rng=rng).scan
    rows = features(with_ranges(scan, scan.ranges + offset, scan.valid), 0.0, smooth=False)
    return surface(rows[rows[:, 4] > 0])


def test_noiseless_scans_give_the_exact_motion():
    found = align(seen(np.zeros(3)), seen(MOTION), MOTION + np.array([0.08, -0.05, 0.06]), NOISE)
    np.testing.assert_allclose(found.T_a_b, MOTION, atol=3e-4)
    assert found.share > 0.85


def test_a_repeated_scan_fits_where_it_was():
    same = seen(np.zeros(3))
    np.testing.assert_allclose(align(same, same, np.zeros(3), NOISE).T_a_b, np.zeros(3), atol=1e-6)


def test_scans_of_different_places_do_not_match():
    assert align(seen(np.zeros(3)), seen([1.0, 0.5, 2.5]), np.zeros(3), NOISE) is None


def test_jacobian_by_the_pose():
    """Points are up to 2 cm beside their partners, so b's half of the rotating normal moves e by 1 cm."""
    a, b, at = seen(np.zeros(3)), seen(MOTION), MOTION + np.array([0.002, -0.003, 0.001])
    e, J, off, _ = _misfit(a, b, at, 0.05, NOISE)
    found = jacobian(lambda pose: _misfit(a, b, pose, 0.05, NOISE)[2], at, 1e-7)
    error = np.abs(J[:, :3] * (off / e)[:, None] - found)
    assert np.quantile(error, 0.98) < 0.012


def test_jacobian_by_an_offset_of_all_ranges():
    """If beams hit the surface at different angles, an offset opens a gap."""
    at, offset = MOTION + np.array([0.002, -0.003, 0.001]), 2e-4  # points are float32
    a, b = seen(np.zeros(3)), seen(MOTION)
    long_a, long_b = seen(np.zeros(3), offset=offset), seen(MOTION, offset=offset)
    e, J, off, _ = _misfit(a, b, at, 0.05, NOISE)
    moved = _misfit(long_a, long_b, at, 0.05, NOISE)[2]
    assert len(moved) == len(off)
    error = np.abs(J[:, 3] * (off / e) - (moved - off) / offset)
    assert np.quantile(np.abs(J[:, 3] * (off / e)), 0.9) > 0.05
    assert np.quantile(error, 0.9) < 0.01


def test_errors_are_consistent_with_the_information(rng):
    """NEES of 60 motions: 3 for independent points; smoothing correlates their errors."""
    nees = []
    for _ in range(60):
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        motion = rng.normal(0.0, [0.2, 0.1, 0.2])
        a, b = seen(pose, 0.005, rng), seen(compose(pose, motion), 0.005, rng)
        found = align(a, b, motion + rng.normal(0.0, [0.02, 0.02, 0.02]), NOISE)
        error = found.T_a_b - motion
        nees.append(error @ found.information[:3, :3] @ error)
    assert 0.7 < np.mean(nees) / 3.0 < 1.8


@pytest.mark.parametrize("noise", [0.003, 0.01])
def test_errors_of_normals_do_not_determine_the_position_along_a_corridor(rng, noise):
    """Matches stay near a guess that is 1 m off; the position across and the turn are known."""
    walls, heading, nees = room(-50.0, 50.0, -1.0, 1.0), 0.3, []
    begin, motion = np.array([0.0, 0.1, heading]), np.array([1.0, 0.02, 0.05])
    along = np.array([np.cos(heading), -np.sin(heading), 0.0])
    across = np.array([np.sin(heading), np.cos(heading), 0.0])
    for _ in range(20):
        a, b = (seen(pose, noise, rng, walls=walls) for pose in (begin, compose(begin, motion)))
        found = align(a, b, motion - along, (noise, 0.0))
        C = np.linalg.inv(found.information + 1e-6 * np.eye(4))[:3, :3]
        assert np.sqrt(along @ C @ along) > 5.0
        assert np.sqrt(across @ C @ across) < 0.05
        assert np.sqrt(C[2, 2]) < 0.01
        error = found.T_a_b - motion
        nees.append(error @ np.linalg.solve(C, error))
    assert np.mean(nees) < 6.0


def test_noise_does_not_bias_the_range_offset(rng):
    """80 motions with noise of 15 mm, NEES of pose and offset. With raw points: 14 instead of 4, -20 mm.

    A third of that offset remains, because errors of normals and points are correlated.
    """
    offsets, weights, nees = [], [], []
    for _ in range(80):
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        motion = rng.normal(0.0, [0.2, 0.1, 0.2])
        a, b = seen(pose, 0.015, rng), seen(compose(pose, motion), 0.015, rng)
        found = align(a, b, motion, (0.015, 0.0))
        error = found.joint - np.append(motion, 0.0)
        nees.append(error @ found.information @ error)
        offsets.append(found.joint[3])
        weights.append(1.0 / np.linalg.inv(found.information)[3, 3])
    assert 0.7 < np.mean(nees) / 4.0 < 1.5
    assert abs(np.average(offsets, weights=weights)) < 0.012


def test_smoothing_keeps_lines_and_circles():
    angles = np.linspace(-0.6, 0.6, 40)
    normals = np.column_stack((np.cos(angles), np.sin(angles)))
    wall = np.column_stack((np.ones(40), np.tan(angles)))
    for points, facing in ((0.2 * normals, normals), (wall, np.tile([1.0, 0.0], (40, 1)))):
        rows = np.column_stack((points, facing, np.ones(40)))
        np.testing.assert_allclose(surface(rows).points, points, atol=1e-9)


def test_no_scan_is_in_two_pairs():
    stamps = 0.1 * np.arange(200)
    poses = np.column_stack((0.05 * np.arange(200), np.zeros(200), np.zeros(200)))
    poses[100:] = poses[100]  # stationary
    trusted = np.arange(200) != 50
    begins, ends = pairs(LidarPath(stamps, poses, trusted, trusted, twists(stamps, poses)))
    rows = np.concatenate((begins, ends))
    assert len(np.unique(rows)) == len(rows)
    assert np.all(trusted[rows])
    assert not np.any((begins < 50) & (ends > 50))
    assert np.all((ends - begins <= 31) & (ends > begins))


def test_the_noise_of_scans_does_not_select_them(rng):
    """5 cm per scan, noise of 1 cm: chosen by their own distance, scans are 3 mm too far apart."""
    n = 12_000
    noise = rng.normal(0.0, 0.01, n)
    poses = np.column_stack((0.05 * np.arange(n) + noise, np.zeros((n, 2))))
    stamps, trusted = 0.1 * np.arange(n), np.ones(n, bool)
    begins, ends = pairs(LidarPath(stamps, poses, trusted, trusted, twists(stamps, poses)))
    assert len(begins) > 1000
    assert abs(np.mean(noise[ends] - noise[begins])) < 0.0015  # four standard errors


@pytest.mark.parametrize("beam_time", [0.0, 1e-4])
def test_path_of_a_simulated_lidar(beam_time):
    """Sweeps of 0.07 s are as accurate as instant ones: the lidar's own motion de-skews them."""
    config = load("imp")
    found = record_batches(
        config, batches((type(m).__name__, m) for m in perfect(load_world("room"), beam_time))
    )
    _, lidar = first_lidar(config)
    path = lidar_path(lidar, found.scans)
    assert path.trusted.all()
    motions = match_pairs(lidar, found.scans, path)
    mount = np.array(lidar.mount)
    true = [compose(interpolate(found.truth, t), mount) for t in (motions.begins, motions.ends)]
    error = motions.T_begin_end - between(*true)
    assert len(error) > 5
    np.testing.assert_allclose(error.std(axis=0), 0.0, atol=1e-3)


def test_no_scan_is_matched_twice_where_scans_do_not_fit(monkeypatch):
    """The tracker restarts where it is lost: at once, not after the scans that it was given with."""
    follow, matched = ScanToMap.steps, list[int]()

    def counted(tracker, motions, sweeps, gate):
        matched.append(len(sweeps))
        return follow(tracker, motions, sweeps, gate)

    monkeypatch.setattr(ScanToMap, "steps", counted)
    rooms = [cast(room(-1.0 - k % 3, 3.0, -2.0, 1.0 + k % 4)).scan for k in range(150)]
    scans = [
        ("LaserScan", LaserScan(0.1 * k, s.angles, s.ranges, np.zeros(len(s.ranges))))
        for k, s in enumerate(rooms)
    ]
    path = lidar_path(Lidar2D(), record_batches(load("default"), batches(scans)).scans)
    assert path.trusted.sum() < 50
    assert sum(matched) == len(path.poses) == 150


@pytest.mark.parametrize("count", [0, 1, 300])
@pytest.mark.parametrize("radius", [0.05, 2.0])
def test_nearest_points_are_those_of_a_tree(count, radius):
    rng = np.random.default_rng(3)
    points, others = rng.uniform(-5.0, 5.0, (2, count, 2))
    others[: count // 3, 0] = points[: count // 3, 0]  # a wall along y
    _, rows = cKDTree(others).query(points, distance_upper_bound=radius)
    assert (nearest(points, others, radius) == np.where(rows < count, rows, -1)).all()
    assert (nearest(points, np.empty((0, 2)), radius) == -1).all()
