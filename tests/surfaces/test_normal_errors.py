"""The spurious information of normals: that of walls is known, objects and exact scans have none."""

import math

import numpy as np
import pytest
from tests.extractors.scans import cast
from tests.surfaces.test_surface_map import CORRIDOR, ROOM, map_of

from impslam.surfaces.features import features
from impslam.surfaces.normal_errors import spurious_information
from impslam.surfaces.surface_map import no_evidence, normal_equations

SCALE, NO_WALLS = 0.06, np.empty((0, 2, 2))
ANGLES = np.linspace(-math.pi, math.pi, 360, endpoint=False)
RING = np.array([[4 * math.cos(a), 4 * math.sin(a)] for a in np.linspace(0, 2 * math.pi, 121)])
RING = np.stack((RING[:-1], RING[1:]), 1)
AROUND_RING = (0.5, 1.0)
"""Where the robot is in the ring; a turn about its centre moves it by (-1, 0.5) per rad."""


def scan_at(pose, lines, circles=None, noise=0.0, rng=None, reach=8.0):
    scene = cast(
        lines, circles, pose=np.array(pose), angles=ANGLES, range_max=reach, noise=noise, rng=rng
    )
    return features(scene.scan, 0.05)


def both(pose, first, second):
    """Return the whole information (3, 3) of the second scan in the map of the first, and the spurious."""
    known, evidence, pose = map_of((first, pose)), no_evidence(), np.array(pose, float)
    normal_equations(known, second, pose, SCALE, 1, evidence)
    return evidence.H, spurious_information(known, second, pose, SCALE)


@pytest.mark.parametrize(
    ("lines", "pose", "direction", "reach"),
    [
        (CORRIDOR, (3.0, 0.2, 0.4), (1.0, 0.0, 0.0), 3.0),
        (RING, (*AROUND_RING, 0.7), (-AROUND_RING[1], AROUND_RING[0], 1.0), 8.0),
        (RING, (0.0, 0.0, -2.0), (0.0, 0.0, 1.0), 8.0),
    ],
    ids=["corridor", "ring", "centre of the ring"],
)
def test_what_noise_shows_along_walls_is_spurious(rng, lines, pose, direction, reach):
    """Exact walls show nothing in this direction, so all of the information there is that of noise.

    Beams that graze the walls of the corridor are left out: single points count in all directions.
    """
    u, whole, spurious = np.array(direction), [], []
    for _ in range(40):
        H, S = both(
            pose, *(scan_at(pose, lines, noise=0.01, rng=rng, reach=reach) for _ in range(2))
        )
        whole.append(u @ H @ u)
        spurious.append(u @ S @ u)
        assert np.linalg.eigvalsh(S)[0] >= -1e-12
        assert np.trace(S[:2, :2]) < 0.05 * np.trace(H[:2, :2])
    assert np.mean(spurious) == pytest.approx(np.mean(whole), rel=0.15)
    H, S = both(pose, *(scan_at(pose, lines, reach=reach) for _ in range(2)))
    assert u @ S @ u == pytest.approx(0.0, abs=0.05 * np.mean(whole))


def test_it_turns_with_the_map(rng):
    first, second = (scan_at((0.5, 0.3, 0.2), ROOM, noise=0.01, rng=rng) for _ in range(2))
    _, S = both((0.0, 0.0, 0.0), first, second)
    _, turned = both((0.0, 0.0, math.pi / 2), first, second)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(turned, R @ S @ R.T, rtol=0.3, atol=0.1 * np.abs(S).max())


def test_posts_show_where_they_are(rng):
    posts = np.array([[1.5, 0.3, 0.05], [-1.0, -1.2, 0.1], [0.5, 2.0, 0.15]])
    first, second = (scan_at((0.0, 0.0, 0.0), NO_WALLS, posts, 0.01, rng) for _ in range(2))
    assert (first[:, 4] > 0.0).any()
    _, S = both((0.0, 0.0, 0.0), first, second)
    assert not S.any()


def test_walls_in_another_place_count_for_nothing(rng):
    """As do those outside the grid, and a pose that is not finite."""
    scan = scan_at((0.0, 0.0, 0.0), ROOM, noise=0.01, rng=rng)
    known = map_of((scan, (0.0, 0.0, 0.0)))
    for pose in ([8.0, 8.0, 0.3], [500.0, 0.0, 0.0], [np.nan, 0.0, 0.0]):
        assert not spurious_information(known, scan, np.array(pose), SCALE).any()
