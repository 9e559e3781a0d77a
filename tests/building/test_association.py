"""Sightings are grouped by what is near them; what is far away neither matters nor takes time."""

import time

import numpy as np

from impslam.building.association import associate
from impslam.building.groups import Rules
from impslam.building.sightings import PlacedSightings

SIGMA = 0.03


def grouped(places, keyframes, is_line=False, directions=np.nan, half=0.0):
    """Return the group of each sighting at places (n, 2), in any order of places."""
    n = len(places)
    frames = np.column_stack([places, np.full(n, directions), np.full(n, half)])
    covariance = np.tile([SIGMA**2, 0.0, SIGMA**2], (n, 1))
    placed = PlacedSightings(frames, covariance, covariance)
    return associate(placed, keyframes, np.full(n, -1), np.zeros((n, 3)), Rules(is_line, 1.0, 0.01))


def test_distant_parts_of_a_map_are_grouped_as_each_alone():
    """Lines have extents of metres, which reach over cells of the grid."""
    rng = np.random.default_rng(0)
    parts = [rng.uniform(0.0, 20.0, (300, 2)).round() for _ in range(5)]
    parts = [part + rng.normal(0.0, SIGMA, part.shape) for part in parts]
    offsets = np.array([[0.0, 0.0], [70.0, 0.0], [-300.0, 40.0], [0.0, 1e4], [5.0, -80.0]])
    whole = np.concatenate([part + offset for part, offset in zip(parts, offsets, strict=True)])
    for is_line in (False, True):
        settings = (is_line, 0.0, 4.0) if is_line else ()
        keyframes = np.arange(1500) // 3
        each = [grouped(part, keyframes[:300], *settings) for part in parts]
        assert all(50 < len(np.unique(groups)) < 300 or is_line for groups in each)
        expected = np.concatenate([groups + 300 * k for k, groups in enumerate(each)])
        np.testing.assert_array_equal(grouped(whole, keyframes, *settings), expected)


def seconds(n):
    """Return the time of n sightings with 16 m^2 for each, all of different points."""
    rng = np.random.default_rng(n)
    places, keyframes = rng.uniform(0.0, 4.0 * np.sqrt(n), (n, 2)), np.arange(n) // 5
    start = time.process_time()
    groups = grouped(places, keyframes)
    assert len(np.unique(groups)) > 0.9 * n
    return time.process_time() - start


def test_the_time_grows_with_the_sightings_not_with_their_square():
    seconds(10)  # compile
    assert min(seconds(32_000) for _ in range(3)) < 20.0 * min(seconds(4_000) for _ in range(3))
