"""Scans that contradict what was seen before, and scans that only show what was not."""

import numpy as np
import pytest

from impslam.geometry.se2 import compose
from impslam.surfaces.features import Sampling, find_features
from impslam.surfaces.surface_map import add, empty_surface_map
from impslam.tracking.beams import Geometry
from impslam.tracking.contradictions import MIN_CONTRADICTED, contradicted_share, shows_surfaces
from impslam.tracking.reference_scan import LastScan

ROOM = [
    [(-2, -2), (3, -2)],
    [(3, -2), (3, -0.5)],
    [(3, 0.5), (3, 2)],
    [(3, 2), (-2, 2)],
    [(-2, 2), (-2, -2)],
]
"""A room of 5 x 4 m with a door of 1 m in its right wall."""
HALL = [
    [(3, -8), (3, -0.5)],
    [(3, 0.5), (3, 8)],
    [(3, 8), (12, 8)],
    [(12, 8), (12, -8)],
    [(12, -8), (3, -8)],
]
"""The hall behind the door, 9 x 16 m."""
WORLD = np.array(ROOM + HALL, float)
BEAMS, SPACING = 361, np.radians(0.5)
GEOMETRY = Geometry(np.array([0.1, 0.0, 0.0]), -np.pi / 2, SPACING)
ANGLES = -np.pi / 2 + SPACING * np.arange(BEAMS)


def scan_at(pose, walls=WORLD):
    """Return the ranges of a scan at a pose of base_link."""
    x, y, theta = compose(np.array(pose, float), GEOMETRY.laser)
    directions = np.stack((np.cos(ANGLES + theta), np.sin(ANGLES + theta)), axis=-1)[:, None]
    along, start = walls[:, 1] - walls[:, 0], walls[:, 0] - (x, y)
    across = directions[..., 0] * along[:, 1] - directions[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        u = (start[:, 0] * directions[..., 1] - start[:, 1] * directions[..., 0]) / across
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)


def features_of(ranges):
    directions = np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=-1)
    origins = np.tile(GEOMETRY.laser[:2], (BEAMS, 1))
    points, found = origins + ranges[:, None] * directions, np.empty((BEAMS, 5), np.float32)
    everything, sampling = np.ones(BEAMS, bool), Sampling(SPACING, 0.04, smooth=True)
    return found[: find_features(points, everything, ranges, origins, sampling, found)]


def contradicted(poses, pose, seen=None, valid=None, before=WORLD):
    """Return the share of a scan, seen at one pose and placed at another, after scans at some poses.

    Those before show the walls `before`.
    """
    surface_map = empty_surface_map(60.0, 60.0, 10_000)
    for place in poses:
        add(surface_map, features_of(scan_at(place, before)), np.array(place, float), 20.0)
    return contradicted_share(
        scan_at(pose if seen is None else seen),
        np.ones(BEAMS, bool) if valid is None else valid,
        np.array(pose, float),
        surface_map.surfels[: surface_map.size[0]],
        LastScan(scan_at(poses[-1], before), np.array(poses[-1], float), GEOMETRY),
    )


APPROACH = [(-1.5, 0, 0), (-0.5, 0, 0), (0.5, 0, 0), (1.5, 0, 0), (2.3, 0.1, 0)]


def test_a_scan_of_a_known_place_contradicts_nothing():
    assert contradicted(APPROACH, (1.0, 0.2, 0.3)) == 0.0


@pytest.mark.parametrize("turn", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("off", [(0.0, 0.0), (0.05, 0.03)])
def test_a_room_behind_a_door_is_no_contradiction(turn, off):
    placed = (3.1 + off[0], 0.1 + off[0], turn + off[1])
    assert contradicted(APPROACH, placed, (3.1, 0.1, turn)) < 0.5 * MIN_CONTRADICTED


@pytest.mark.parametrize(
    ("seen", "off"),
    [
        ((3.05, 0.2, 1.2), (0.0, 0.12)),
        ((3.1, 0.2, 1.5), (-0.1, 0.1)),
        ((3.1, 0.1, 1.5), (-0.15, 0.1)),
    ],
)
def test_ends_of_the_wall_beside_a_door_are_no_contradiction(seen, off):
    """They are 0.3 m from the lidar, so that an error of a decimetre turns them by 20 degrees."""
    placed = (seen[0] + off[0], seen[1] + off[1], seen[2])
    assert contradicted(APPROACH, placed, seen) < 0.5 * MIN_CONTRADICTED


@pytest.mark.parametrize("turn", [-0.6, 0.0, 0.6])
def test_a_door_that_opens_is_no_contradiction(turn):
    closed = np.concatenate((WORLD, [[(3, -0.5), (3, 0.5)]]))
    for seen in [(2.5, 0.1, turn), (2.9, 0.1, turn)]:
        assert contradicted(APPROACH, seen, before=closed) < 0.5 * MIN_CONTRADICTED


def test_a_person_who_stood_ahead_and_moves_on_is_no_contradiction():
    person = np.concatenate((WORLD, [[(2.3, -0.3), (2.3, 0.3)]]))
    seen = APPROACH[-2]
    assert (scan_at(seen, person) < scan_at(seen)).mean() > MIN_CONTRADICTED
    assert contradicted(APPROACH[:-1], seen, before=person) < 0.5 * MIN_CONTRADICTED


def test_a_wall_that_is_gone_is_a_contradiction():
    wall = np.concatenate((WORLD, [[(2.7, -2), (2.7, 2)]]))
    assert contradicted(APPROACH[:-1], APPROACH[-2], before=wall) > 2 * MIN_CONTRADICTED


@pytest.mark.parametrize("elsewhere", [(8, 0, 0), (5, -6, 2), (9, 6, -1.5), (8, 2, 3)])
def test_a_robot_carried_to_another_place_is_contradicted(elsewhere):
    assert contradicted(APPROACH, APPROACH[-2], elsewhere) > 2 * MIN_CONTRADICTED
    hall = [(9, -4, 1.5), (9, -2, 1.5), (9, 0, 1.5), (8.5, 2, 2.5)]
    assert contradicted(hall, hall[-1], (0, 0, 1)) > 2 * MIN_CONTRADICTED


def test_invalid_beams_do_not_count():
    valid = ANGLES < 0
    share = contradicted(APPROACH, APPROACH[-2], (8, 0, 0), valid)
    assert 0.0 < share <= 1.0
    assert contradicted(APPROACH, APPROACH[-2], (8, 0, 0), np.zeros(BEAMS, bool)) == 0.0


def test_beams_of_one_direction_contradict_nothing():
    one = Geometry(np.zeros(3), 0.0, 0.0)
    last = LastScan(np.array([5.0]), np.zeros(3), one)
    share = contradicted_share(
        np.array([2.0]), np.ones(1, bool), np.zeros(3), np.zeros((0, 8)), last
    )
    assert share == 0.0


def test_noise_shows_no_surfaces_and_few_beams_on_jagged_walls_do():
    """Every fifth point is on a wall; the others are on shelves and people at any distance before it."""
    rng = np.random.default_rng(2)
    clean, noise = scan_at((0.0, 0.0, 0.0)), rng.uniform(0.3, 5.0, BEAMS)
    assert shows_surfaces(features_of(clean))
    assert not shows_surfaces(features_of(noise))
    on_wall = np.repeat(rng.random(BEAMS // 10 + 1) < 0.2, 10)[:BEAMS]
    assert shows_surfaces(features_of(np.where(on_wall, clean, np.minimum(noise, clean))))
