"""Tiles are equivalent to one large map; maps that share tiles stay separate."""

import numpy as np
import pytest
from tests.estimators.drives import scanned
from tests.extractors.scans import room

from impslam.estimators.shared_maps import SharedMaps
from impslam.surfaces.features import features
from impslam.surfaces.surface_map import (
    MAX_POINTS,
    add,
    empty_surface_map,
    no_evidence,
    normal_equations,
)
from impslam.surfaces.tiles import evidence, sort

HALL = room(-7.0, 9.0, -6.5, 8.2)
PLACES = np.array([[0.0, 0.0, 0.3], [3.0, 2.0, -2.0], [-3.5, 4.1, 1.1], [4.0, 4.0, 3.0]])


def seen(pose):
    return features(scanned(HALL, pose, noise=0.01, rng=np.random.default_rng(3)), 0.04)


def told(maps, particle, rows, pose, scale=0.1):
    """Return the evidence of a scan at a pose by a particle's map, paired from 0.2 m off."""
    out = no_evidence()
    guess = pose + np.array([0.2, -0.15, 0.01])
    some = sort(maps.tables[maps.maps[particle]], maps.origin, rows, guess)
    evidence(maps.tiles, some, pose, scale, out)
    return out


def test_tiles_give_the_same_evidence_as_one_map():
    maps, known = SharedMaps(1), empty_surface_map(40.0, 40.0, 20000)
    for pose in PLACES:
        rows = seen(pose)
        maps.add(rows, pose[None], np.zeros(1, np.int64))
        add(known, rows, pose, MAX_POINTS)
    for scale in (0.05, 0.4):
        pose, one = PLACES[1] + [0.05, -0.03, 0.01], no_evidence()
        normal_equations(known, seen(PLACES[1]), pose, scale, 1, one)
        other = told(maps, 0, seen(PLACES[1]), pose, scale)
        np.testing.assert_allclose(other.H, one.H, rtol=1e-6)
        np.testing.assert_allclose(other.g, one.g, rtol=1e-6, atol=1e-6 * abs(one.g).max())
        np.testing.assert_allclose(other.sums, one.sums, rtol=1e-6)


def test_particles_share_a_map_until_they_diverge():
    maps, lines = SharedMaps(3), np.zeros(3, np.int64)
    maps.add(seen(PLACES[0]), np.tile(PLACES[0], (3, 1)), lines)
    assert len(maps.tables) == 1
    alone = maps.used
    maps.resample(np.array([0, 0, 2]))
    assert maps.used == alone  # nothing is copied
    few, other = seen(PLACES[1])[:40], PLACES[1] + [0.1, 0.05, 0.02]
    maps.add(few, np.array([PLACES[1], PLACES[1], other]), np.array([0, 0, 2]))
    one, two = maps.tables[maps.maps[[0, 2]]]
    shared, own = (one == two) & (one >= 0), one != two
    assert len(maps.tables) == 2
    assert 0 < own.sum() < shared.sum()  # only where they have written since
    apart = SharedMaps(1)  # what the third one has is as if there were no other
    apart.add(seen(PLACES[0]), PLACES[:1], np.zeros(1, np.int64))
    apart.add(few, other[None], np.zeros(1, np.int64))
    rows, pose = seen(PLACES[1]), PLACES[1]
    np.testing.assert_array_equal(told(maps, 2, rows, pose).H, told(apart, 0, rows, pose).H)
    before = told(maps, 0, rows, pose).H
    maps.resample(np.array([0, 0, 0]))
    assert len(maps.tables) == 1
    np.testing.assert_array_equal(told(maps, 2, rows, pose).H, before)


@pytest.mark.parametrize("far", [200.0, -300.0])
def test_the_tables_and_the_pool_grow_with_the_path(far):
    maps, rows, aside = SharedMaps(2), seen(PLACES[0]), np.array([0.3, 0.0, 0.0])
    for k in range(12):
        pose = PLACES[0] + np.array([k * far / 12, -k * far / 24, 0.0])
        maps.add(rows, np.array([pose, pose + aside]), np.arange(2))
        assert told(maps, 1, rows, pose + aside).sums[1] > 0.9 * len(rows)
    assert len(maps.users) > 64
    assert told(maps, 1, rows, PLACES[0] + aside).sums[1] > 0.9 * len(rows)
