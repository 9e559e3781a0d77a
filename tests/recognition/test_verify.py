"""Points on surfaces speak for a pose, points in free space against it, and hidden ones not at all."""

import numpy as np
import pytest
from tests.extractors.scans import regular_angles, room
from tests.recognition.plans import OFFICE, place, walls, way

from impslam.estimators.loop_closing import MIN_CONTRADICTED
from impslam.geometry.se2 import compose
from impslam.recognition.submap import Submap
from impslam.recognition.verify import (
    MIN_SEEN,
    STRONG_SHARE,
    ClosureStrength,
    Support,
    excess_in_free_space,
    judge,
    share_in_free_space,
    verify,
)
from impslam.surfaces.surface_map import add, empty_surface_map

SQUARE = room(-4.0, 4.0, -3.0, 3.0)
SHELF = walls([-1.0, 1.5, 2.0, 1.5])
WAY = way(-1.0, -0.5, 1.0, -0.5, 4)
HERE = np.zeros(3)
TURN = 2.0 * np.pi


def support(reference, query, pose=HERE):
    known = empty_surface_map(40.0, 40.0, 20000)
    add(known, reference.features, HERE, 20.0)
    return verify(known, reference, query, pose)


def free_shares(reference, query, pose=HERE):
    """Return the share of contradicted points, and its excess over those by which either does itself."""
    known = empty_surface_map(40.0, 40.0, 20000)
    add(known, reference.features, HERE, 20.0)
    pair = known, reference, query, pose
    return share_in_free_space(*pair), excess_in_free_space(*pair)


def seen(plan, poses=WAY, seed=0):
    return place(plan, poses, HERE, 0.05, seed=seed)


def test_a_place_supports_itself():
    found = support(seen(SQUARE), seen(SQUARE, seed=1))
    assert found.matched > 0.99
    assert found.query == found.reference == found.agreement == 1.0


def test_what_the_reference_saw_free_contradicts_the_query():
    found = support(seen(SQUARE), seen(np.concatenate([SQUARE, SHELF])))
    assert found.query < 0.9
    assert found.reference > 0.98


def test_what_the_query_saw_free_contradicts_the_reference():
    found = support(seen(np.concatenate([SQUARE, SHELF])), seen(SQUARE))
    assert found.reference < 0.9
    assert found.query > 0.98


def test_contradicted_points_are_counted_on_either_side():
    bare, furnished = seen(SQUARE), seen(np.concatenate([SQUARE, SHELF]))
    for reference, query in ((bare, furnished), (furnished, bare)):
        share, excess = free_shares(reference, query)
        assert 0.05 < excess <= share < 0.3
        assert free_shares(reference, reference) == (0.0, 0.0)


def test_chair_legs_that_most_beams_miss_contradict_nothing():
    """Legs of 2 cm and beams 1 deg apart: from a metre on, some beams pass on either side of a leg."""
    rng, hall, coarse = (
        np.random.default_rng(1),
        room(-7.0, 7.0, -5.0, 5.0),
        regular_angles(360, TURN),
    )
    legs = np.column_stack([rng.uniform((-6, -4), (6, 4), (300, 2)), np.full(300, 0.01)])
    reference, query = (
        place(hall, way(-3.0, y, 3.0, y, 12), HERE, 0.05, circles=legs, seed=seed, angles=coarse)
        for seed, y in enumerate((-0.9, 0.9))
    )
    share, excess = free_shares(reference, query)
    assert share < MIN_CONTRADICTED
    assert excess < 0.0
    assert support(reference, query).agreement > STRONG_SHARE + 0.05
    assert free_shares(reference, query, np.array([0.5, 0.0, 0.6]))[1] > MIN_CONTRADICTED


def test_walls_that_a_submap_contradicts_itself_do_count():
    """The query begins where the reference was, and goes on elsewhere: the robot was carried meanwhile."""
    shelf = np.concatenate([SQUARE, SHELF])
    scans = [seen(plan, WAY) for plan in (SQUARE, shelf)]
    query = Submap(
        np.concatenate([s.features for s in scans]),
        np.concatenate([s.vantages for s in scans]),
        np.concatenate([s.free for s in scans]),
    )
    assert free_shares(seen(SQUARE, seed=1), query)[1] > 0.05


def test_what_the_reference_never_saw_has_no_effect():
    """The query went on, into rooms that the reference knows nothing of."""
    reference = seen(OFFICE, way(-6.0, -0.3, -3.0, -0.3))
    query = seen(OFFICE, way(-4.0, -0.2, 2.0, -0.2), seed=1)
    found = support(reference, query)
    assert 0.3 < found.matched < 0.9
    assert found.agreement > 0.95


@pytest.mark.parametrize(("half", "y"), [(3.0, 1.0), (12.0, 1.2)])
def test_the_far_side_of_a_thin_wall_is_no_match(half, y):
    """Most of a long one is seen obliquely: its normals have no weight, but still tell the sides apart."""
    wall = walls([-half, 0.0, half, 0.0])
    front = seen(wall, way(-1.0, -y, 1.0, -y))
    behind = seen(wall, way(-1.0, y, 1.0, y))
    assert support(front, front).matched == 1.0
    assert support(front, behind).matched < 0.05


def test_frames_do_not_matter(rng):
    reference, query = seen(OFFICE), seen(OFFICE, way(0.0, -0.3, 2.0, 0.2), seed=1)
    found = support(reference, query)
    T = np.array([1.5, -0.7, 2.0])
    turned = place(OFFICE, way(0.0, -0.3, 2.0, 0.2), T, 0.05, seed=1)
    np.testing.assert_allclose(support(reference, turned, compose(HERE, T)), found, rtol=0.04)


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        (Support(0.4, 0.9, 0.85, MIN_SEEN), ClosureStrength.STRONG),
        (Support(0.4, 0.9, 0.7, MIN_SEEN), ClosureStrength.WEAK),
        (Support(0.4, 0.7, 0.9, MIN_SEEN), ClosureStrength.WEAK),
        (Support(0.4, 0.9, 0.6, MIN_SEEN), ClosureStrength.REFUSED),
        (Support(0.3, 1.0, 1.0, MIN_SEEN), ClosureStrength.REFUSED),
        (Support(0.9, 1.0, 1.0, MIN_SEEN - 1), ClosureStrength.REFUSED),
    ],
)
def test_verdicts(found, verdict):
    assert judge(found) == verdict


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        (Support(0.2, 0.9, 0.85, 40), ClosureStrength.WEAK),
        (Support(0.2, 0.9, 0.75, 40), ClosureStrength.REFUSED),
        (Support(0.15, 1.0, 1.0, 40), ClosureStrength.REFUSED),
        (Support(0.9, 1.0, 1.0, 30), ClosureStrength.REFUSED),
        (Support(0.4, 0.9, 0.85, MIN_SEEN), ClosureStrength.STRONG),
        (Support(0.4, 0.9, 0.7, MIN_SEEN), ClosureStrength.WEAK),
    ],
)
def test_verdicts_where_submaps_share_little(found, verdict):
    """At best a weak one, for which others have to agree, and free space as for a strong one."""
    assert judge(found, overlap=0.2) == verdict
