"""How two maps lie to each other: found where they overlap, and told where it cannot be."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.maps.drawn import mapped
from tests.recognition.plans import CORRIDOR, OFFICE, walls, way

from impslam.errors import ImpError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose
from impslam.maps.joining import joined
from impslam.maps.relation import RelationStatus, SegmentMatch, align_maps, aligned_to, fit, judge

ALONG = way(-7.0, -0.3, 8.0, -0.2, 30)
ROOMS = np.concatenate([way(-2.5, 0.0, -2.5, 5.0, 10), way(-2.5, 5.0, -2.5, 0.3, 10), ALONG[10:]])
T = np.array([3.0, -4.0, 2.2])
OTHER = np.concatenate(
    [room(0.0, 9.0, 0.0, 5.5), walls([3, 0, 4, 3], [6, 5.5, 5, 4], [7, 2, 8, 2])]
)
OTHER_WAY = np.concatenate(
    [way(1, 1, 1.5, 4.5, 10), way(1.5, 4.5, 6, 3.5, 12), way(6, 3.5, 8.3, 1, 8)]
)


def test_maps_of_two_drives_through_an_office_are_aligned():
    one, other = mapped(OFFICE, ALONG), mapped(OFFICE, ROOMS, T=T, seed=1)
    told = []
    found = align_maps(one.keyframes, other.keyframes, told.append)
    assert found.outcome is RelationStatus.FOUND
    back = compose(found.T, T)
    assert math.hypot(back[0], back[1]) < 0.03
    assert abs(wrap(back[2])) < 0.005
    assert told[0] == 0.0
    assert told == sorted(told)
    moved = aligned_to(one, other)
    np.testing.assert_allclose(moved.keyframes.poses[:, :2], ROOMS[:, :2], atol=0.05)


def test_two_buildings_have_no_place_in_common():
    one, other = mapped(OFFICE, ALONG), mapped(OTHER, OTHER_WAY, seed=1)
    found = align_maps(one.keyframes, other.keyframes)
    assert found.outcome is RelationStatus.APART
    with pytest.raises(ImpError, match="no place in common"):
        aligned_to(one, other)


UPSTAIRS = np.concatenate(
    [
        room(-8.0, 9.0, -5.0, 6.0),
        walls(
            [-8, 1, -3, 1],
            [-2, 1, 0, 1],
            [-8, -1.5, -5, -1.5],
            [-4, -1.5, 0, -1.5],
            [-4, 1, -4, 6],
            [-1, -1.5, -1, -5],
            [-7, 3, -6, 3.4],
            [-6, 3.4, -6, 4.5],
            [-5.5, -3.5, -4.2, -3.2],
            [0, 1, 0, 6],
            [0, -1.5, 0, -5],
            [3, -5, 3, -3.5],
            [7, 2, 7, 6],
        ),
    ]
)
"""The left half is that of `OFFICE`."""


@pytest.mark.parametrize(("plan", "same"), [(OFFICE, True), (UPSTAIRS, False)])
def test_floors_that_are_half_the_same_are_not_one(plan, same):
    back_and_forth = [
        way(-7, -0.3, 0, -0.2, 16),
        way(0, 0.2, -7, 0.3, 16),
        way(-7, -0.3, 8, -0.2, 30),
    ]
    drive = np.concatenate(back_and_forth)
    one, other = mapped(OFFICE, ALONG), mapped(plan, drive, T=T, seed=1)
    found = align_maps(one.keyframes, other.keyframes)
    assert len(found.links) >= 3
    if same:
        assert found.outcome is RelationStatus.FOUND
        assert found.misfit < 0.02
    else:
        assert found.outcome is RelationStatus.AMBIGUOUS
        assert found.misfit > 0.3
        with pytest.raises(ImpError, match="contradict the other map"):
            aligned_to(one, other)


def test_a_bare_corridor_cannot_be_aligned():
    one = mapped(CORRIDOR, way(-30.0, 0.0, 30.0, 0.1, 40))
    other = mapped(CORRIDOR, way(-20.0, 0.2, 20.0, -0.1, 30), seed=1)
    assert align_maps(one.keyframes, other.keyframes).outcome is not RelationStatus.FOUND


def test_stretches_that_fit_at_several_places_are_counted():
    """Two drives through a hall that looks the same when turned by 180 degrees."""
    hall = np.concatenate([room(-8.0, 8.0, -5.0, 5.0), walls([-5, 0, -2, 0], [2, 0, 5, 0])])
    lap = np.concatenate(
        [way(-6.5, -3, 6.5, -3, 20), way(6.5, -3, 6.5, 3, 10), way(6.5, 3, -6.5, 3, 20)]
    )
    found = align_maps(mapped(hall, lap).keyframes, mapped(hall, lap, seed=1).keyframes)
    assert found.outcome is not RelationStatus.FOUND
    assert found.uncertain >= found.searched / 2
    assert f"{found.uncertain} fit at several places, or uncertainly" in found.words


def test_a_map_of_one_place_is_too_short_to_be_aligned():
    one, other = mapped(OFFICE, ALONG), mapped(OFFICE, ALONG[:1], seed=1)
    assert align_maps(one.keyframes, other.keyframes).outcome is RelationStatus.APART


def links(poses, T, rows):
    return [SegmentMatch(row, compose(T, poses[row])) for row in rows]


def test_few_contradicting_links_are_outvoted_and_many_are_not():
    true = links(ROOMS, T, (0, 8, 15, 22, 30))
    false = links(ROOMS, np.array([0.0, 5.0, 0.0]), (4, 12, 26))
    few = judge([*true, false[0]], ROOMS, 9)
    assert few.outcome is RelationStatus.FOUND
    assert few.links == tuple(true)
    np.testing.assert_allclose(few.T, T, atol=1e-9)
    many = judge([*true, *false], ROOMS, 9)
    assert many.outcome is RelationStatus.AMBIGUOUS
    assert "ambiguous" in many.words


def test_two_that_agree_are_too_few():
    assert judge(links(ROOMS, T, (0, 20)), ROOMS, 9).outcome is RelationStatus.AMBIGUOUS
    assert judge(links(ROOMS, T, (0,)), ROOMS, 9).outcome is RelationStatus.APART
    assert judge([], ROOMS, 9).outcome is RelationStatus.APART


def test_the_fit_is_exact_for_exact_links_and_close_for_noisy_ones(rng):
    exact = compose(T, ROOMS)
    np.testing.assert_allclose(fit(ROOMS, exact), T, atol=1e-9)
    noisy = exact + rng.standard_normal(exact.shape) * [0.1, 0.1, 0.02]
    np.testing.assert_allclose(fit(ROOMS, noisy), T, atol=0.06)


def test_unplaced_keyframes_are_ignored():
    one, other = mapped(OFFICE, ALONG), mapped(OFFICE, ROOMS, T=T, seed=1)
    k = len(other.keyframes)
    lost = mapped(OTHER, OTHER_WAY, seed=2).keyframes
    both = joined(mapped(OTHER, OTHER_WAY, seed=2), other, []).keyframes
    placed = both.sessions == 1
    found = align_maps(one.keyframes, replace(both, placed=placed))
    assert found.outcome is RelationStatus.FOUND
    assert all(len(lost) <= link.row < len(lost) + k for link in found.links)
    alone = align_maps(one.keyframes, other.keyframes)
    np.testing.assert_allclose(found.T, alone.T, atol=1e-9)
