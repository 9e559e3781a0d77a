"""What every lifecycle keeps, with every filter and association beside it."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, drive, observe

from impslam.component import components
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Increment, LaserScan, Match, Observation


@pytest.fixture(params=sorted(components("lifecycle")))
def lifecycle(request):
    return components("lifecycle")[request.param]()


def begin(lifecycle, filter_="ekf", association="known"):
    made = components("filter")[filter_](), components("association")[association]()
    lifecycle.start(MODELS, made[1], made[0])
    return lifecycle


def entries(lifecycle, steps=60, rng=None, lost=False):
    """Return which observations are promoted at each step of a drive, none of them ever matched."""
    found = []
    for pose, increment in drive(steps, rng):
        seen = observe(pose, rng)
        lifecycle.move(increment)
        promoted = lifecycle.promote(seen, increment.stamp, lost)
        assert all(isinstance(i, int) and 0 <= i < len(seen) for i in promoted)
        assert len(set(promoted)) == len(promoted)
        found.append([seen[i].label for i in promoted])
    return found


@pytest.mark.parametrize("filter_", sorted(components("filter")))
@pytest.mark.parametrize("association", sorted(components("association")))
def test_what_is_seen_again_and_again_becomes_a_landmark(lifecycle, filter_, association):
    found = entries(begin(lifecycle, filter_, association))
    assert {label for step in found for label in step} == {*range(5), *range(100, 104)}


def test_nothing_becomes_of_nothing(lifecycle):
    begin(lifecycle)
    for k in range(20):
        lifecycle.move(Increment(0.1 * k, np.zeros(3), 1e-8 * np.eye(3), 0.1))
        assert lifecycle.promote((), 0.1 * k, k == 0) == []


def test_an_empty_map_takes_what_there_is(lifecycle):
    assert len(entries(begin(lifecycle), steps=1, lost=True)[0]) == 9


def test_a_new_run_is_like_the_first(lifecycle):
    runs = [entries(begin(lifecycle), rng=np.random.default_rng(3)) for _ in range(2)]
    assert runs[0] == runs[1]


def wall_scan():
    """Return a scan of a wall 3 m ahead."""
    angles = np.linspace(-1, 1, 401)
    message = LaserScan(0.0, angles, 3.0 / np.cos(angles), np.zeros(401))
    return Lidar2D().scan(message, np.zeros(3))


def review(lifecycle, x, matched, steps=60):
    """Return after how many reviews of a point at x m ahead each landmark goes."""
    ids, gone = np.array([3, 8]), {}
    seen = (Observation("cylinder", np.array([x, 0.0]), 1e-4 * np.eye(2)),)
    for k in range(steps):
        lifecycle.move(Increment(0.1 * k, np.zeros(3), 1e-8 * np.eye(3), 0.1))
        lifecycle.promote(() if matched else seen, 0.1 * k, lost=False)
        outlines = np.full((len(ids), 2, 2), [x, 0.0])
        matches = [Match(0, int(i), np.zeros(2), np.eye(2), 0.0) for i in ids if matched]
        removed = lifecycle.review(wall_scan(), np.zeros(3), ids, outlines, matches)
        assert set(removed) <= set(ids.tolist())
        assert len(set(removed)) == len(removed)
        gone |= dict.fromkeys(removed, k)
        ids = ids[~np.isin(ids, removed)]
    return gone


@pytest.mark.parametrize("x", [2.0, 3.0, 4.0])
def test_what_is_matched_stays(lifecycle, x):
    assert review(begin(lifecycle), x, matched=True) == {}


@pytest.mark.parametrize("x", [3.0, 4.0])
def test_what_cannot_be_seen_through_stays(lifecycle, x):
    assert review(begin(lifecycle), x, matched=False) == {}


def test_an_empty_map_has_nothing_to_lose(lifecycle):
    nothing = np.empty(0, np.int64), np.empty((0, 2, 2)), []
    assert begin(lifecycle).review(wall_scan(), np.zeros(3), *nothing) == []
