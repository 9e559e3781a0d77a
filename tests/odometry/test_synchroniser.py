"""Motions compose exactly however they are cut, and each sweep gets those before its middle."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import wrapped
from tests.sensing import at_rest, joined, split

from impslam.columns import Motions
from impslam.geometry.se2 import compose, exp
from impslam.noise import MAX_GAP
from impslam.odometry.stream import unknown_motions
from impslam.odometry.synchroniser import END, MAX_WAIT, PendingSweeps, Synchroniser
from impslam.types import Increment

TWIST = np.array([0.5, 0.1, 0.8])
Q = np.diag([1e-4, 2e-4, 3e-4])
NOTHING = np.empty(0, np.int64), unknown_motions(np.empty(0))


def moving(stamps):
    """Return the motions (m,) of a robot at TWIST between m + 1 stamps."""
    steps = np.diff(stamps)
    return Motions(
        np.array(stamps[1:]), exp(steps[:, None] * TWIST), steps[:, None, None] * Q, steps
    )


def sweeps(begins, ends=None, stamps=None, order=None, usable=True, by_order=False):
    begins = np.array(begins, np.float64)
    ends = begins if ends is None else np.array(ends, np.float64)
    stamps = begins if stamps is None else np.array(stamps, np.float64)
    order = 1000 + np.arange(len(begins)) if order is None else np.array(order)
    return PendingSweeps(
        order, begins, ends, stamps, np.full(len(begins), usable), np.full(len(begins), by_order)
    )


def fed(stamps, order=0, **parameters):
    """Return a synchroniser that knows the motion at TWIST between these stamps."""
    synchroniser, motions = Synchroniser(**parameters), moving(stamps)
    places = order + np.arange(len(stamps) - 1)
    synchroniser.feed(places, motions, sweeps([]), int(places[-1]))
    return synchroniser


def used(synchroniser, waiting):
    """Return what sweeps get of the motion that is known."""
    return synchroniser.feed(*NOTHING, waiting, END)


def reference(stamps, until):
    """Compose the motion at TWIST up to a time with plain increments."""
    total = at_rest(stamps[0])
    for a, b in pairwise(stamps):
        whole = Increment(b, exp((b - a) * TWIST), (b - a) * Q, b - a)
        if b <= until:
            total = joined(total, whole)
        elif a < until:
            total = joined(total, split(whole, (until - a) / (b - a))[0])
    return total


@given(st.lists(st.floats(0.01, 4.99), min_size=1, max_size=8))
def test_sweeps_at_any_time_get_the_motion_up_to_it(times):
    stamps = np.linspace(0.0, 5.0, 26)
    times = sorted(times)
    got = used(fed(stamps), sweeps(times))
    pose, total = np.zeros(3), at_rest(0.0)
    for k, time in enumerate(times):
        pose = compose(pose, got.motions.d_pose[k])
        total = joined(total, got.motions.row(k))
        assert np.abs(wrapped(pose - exp(time * TWIST), 2)).max() < 1e-9
        np.testing.assert_allclose(total.covariance, reference(stamps, time).covariance, atol=1e-14)
    assert total.duration == pytest.approx(times[-1])


@given(st.floats(0.01, 4.8))
def test_the_twist_over_a_sweep_is_that_of_the_motion(time):
    got = used(fed(np.linspace(0.0, 5.0, 26)), sweeps([time], [time + 0.1]))
    np.testing.assert_allclose(got.twists[0], TWIST, atol=1e-9)


def test_a_part_and_the_rest_compose_to_the_whole():
    whole = reference([0.0, 1.0], 1.0)
    got = used(fed([0.0, 1.0]), sweeps([0.3, 1.0]))
    again = joined(got.motions.row(0), got.motions.row(1))
    np.testing.assert_allclose(again.d_pose, whole.d_pose, atol=1e-12)
    np.testing.assert_allclose(again.covariance, whole.covariance, atol=1e-15)


def test_covariance_of_a_composition_by_monte_carlo(rng):
    first = Increment(1.0, np.array([0.4, 0.1, 0.5]), np.diag([1e-4, 2e-4, 1e-3]), 1.0)
    second = Increment(2.0, np.array([0.3, -0.1, -0.2]), np.diag([3e-4, 1e-4, 2e-3]), 1.0)
    both = Motions(*(np.array(c) for c in zip(*(
        (m.stamp, m.d_pose, m.covariance, m.duration) for m in (first, second)
    ), strict=True)))  # fmt: skip
    synchroniser = Synchroniser()
    synchroniser.feed(np.arange(2), both, sweeps([]), 1)
    ends = compose(
        first.d_pose + rng.multivariate_normal(np.zeros(3), first.covariance, 20000),
        second.d_pose + rng.multivariate_normal(np.zeros(3), second.covariance, 20000),
    )
    np.testing.assert_allclose(np.cov(ends.T), synchroniser.ahead().covariance, atol=6e-5)


def test_a_sweep_recorded_with_odometry_gets_all_motion_though_stamps_run_back():
    stamps = np.array([10.1, 10.9, 10.3])
    motions = Motions(
        stamps, np.tile([1.0, 0, 0], (3, 1)), np.tile(np.eye(3), (3, 1, 1)), stamps * 0 + 0.1
    )
    synchroniser = Synchroniser()
    got = synchroniser.feed(np.arange(3), motions, sweeps([10.3], order=[3]), 3)
    np.testing.assert_allclose(got.motions.d_pose, [[3.0, 0, 0]])


def test_a_sweep_waits_for_odometry_to_reach_its_end():
    synchroniser = fed(np.linspace(0.0, 1.0, 11))
    waiting = sweeps([0.95], [1.05], order=[10])
    assert len(synchroniser.feed(*NOTHING, waiting, 10).twists) == 0
    more = moving([1.0, 1.1])
    got = synchroniser.feed(np.array([11]), more, waiting, 11)
    np.testing.assert_allclose(got.motions.d_pose[0], exp(TWIST), atol=1e-12)


def test_a_sweep_waits_for_so_many_rows_of_any_stream_and_gets_no_later_motion():
    """Unused rows count by their position in the log, whatever their batch."""
    late = moving([1.0, 1.01])
    for place, expected in ((10 + MAX_WAIT, 1.01), (11 + MAX_WAIT, 1.0)):
        synchroniser = fed(np.linspace(0.0, 1.0, 11))
        synchroniser.max_late = 0.0
        waiting = sweeps([5.0], order=[10])
        assert len(synchroniser.feed(*NOTHING, waiting, 10 + MAX_WAIT - 1).twists) == 0
        got = synchroniser.feed(np.array([place]), late, waiting, place)
        assert got.motions.duration[0] == pytest.approx(expected)


def late(before, after, scans=20):
    """Return what sweeps get if odometry at 10 Hz up to `before` s comes 1000 rows before the rest.

    The rest begins at `after` s. The sweeps are 0.1 s apart, from 1.05 s on.
    """
    synchroniser = fed(np.linspace(0.0, before, 11))
    waiting = sweeps(1.05 + 0.1 * np.arange(scans), order=10 + 10 * np.arange(scans))
    assert not len(synchroniser.feed(*NOTHING, waiting, 1000).twists)
    rest = moving(np.linspace(after, after + 5.0, 51))
    first = moving([before, after])
    motions = Motions(*map(np.concatenate, zip(first, rest, strict=True)))
    return synchroniser.feed(1001 + np.arange(51), motions, waiting, 1051)


def test_odometry_that_comes_late_in_a_log_is_used():
    got = late(1.0, 1.1)
    assert len(got.twists) == 20
    np.testing.assert_allclose(got.motions.d_pose[0], exp(1.05 * TWIST), atol=1e-12)
    np.testing.assert_allclose(
        got.motions.d_pose[1:], np.tile(exp(0.1 * TWIST), (19, 1)), atol=1e-12
    )


def test_sweeps_in_a_gap_of_odometry_get_no_share_of_the_motion_across_it():
    got = late(1.0, 1.0 + MAX_GAP + 0.1)
    assert len(got.twists) == 20
    np.testing.assert_allclose(got.motions.d_pose[0], exp(TWIST), atol=1e-12)
    assert not got.motions.d_pose[1:].any()


def test_odometry_that_is_behind_all_the_time_is_of_another_clock():
    """At 10 Hz and 2 s behind: after 25 rows, a sweep gets the motion so far, as before any clock."""
    synchroniser, stamps = fed(np.linspace(-2.0, -1.0, 11)), -1.0 + 0.1 * np.arange(100)
    places = 11 + 2 * np.arange(99)
    waiting = sweeps(1.05 + 0.1 * np.arange(99), order=10 + 2 * np.arange(99))
    got = synchroniser.feed(places, moving(stamps), waiting, 208)
    assert len(got.twists) == 99 - MAX_WAIT // 2
    assert got.motions.duration[1:].max() < 0.11


@pytest.mark.parametrize(("step", "waits"), [(0.1, 300), (10.0, 10)])
def test_late_odometry_is_awaited_for_some_time_of_later_sweeps(step, waits):
    """A gap between sweeps does not count as waiting."""
    synchroniser = fed([0.0, 0.9])
    waiting = sweeps(1.0 + step * np.arange(400), order=1 + np.arange(400))
    got = synchroniser.feed(*NOTHING, waiting, 400)
    assert len(got.twists) == min(400 - waits, 400 - MAX_WAIT)


def test_a_late_stamp_is_reached_by_pending_motion_without_using_it():
    stamps = np.linspace(0.0, 1.0, 11)
    synchroniser = fed(stamps)
    got = used(synchroniser, sweeps([0.25], stamps=[0.7]))
    np.testing.assert_allclose(got.T_middle_stamp[0], exp(0.45 * TWIST), atol=1e-12)
    np.testing.assert_allclose(synchroniser.ahead().d_pose, exp(0.75 * TWIST), atol=1e-12)
    again = used(synchroniser, sweeps([0.7]))
    np.testing.assert_allclose(again.motions.d_pose[0], exp(0.45 * TWIST), atol=1e-12)
    np.testing.assert_allclose(again.motions.covariance, got.stamp_covariance, atol=1e-15)


@pytest.mark.parametrize("delay", [0.5, 1.0])
def test_a_late_stamp_is_awaited_while_odometry_arrives(delay):
    """At 50 Hz, odometry reaches a stamp 0.5 s ahead after 25 rows, and later ones after more."""
    synchroniser = fed(np.linspace(0.0, 1.0, 51))
    waiting, order = sweeps([1.0], stamps=[1.0 + delay], order=[50]), 51
    ticks = np.arange(50, 52 + round(50 * delay)) / 50
    for before, after in pairwise(ticks):
        got = synchroniser.feed(np.array([order]), moving([before, after]), waiting, order + 2)
        order += 3  # two rows of other streams follow each
        assert len(got.twists) == (after >= 1.0 + delay - 1e-9)
        if len(got.twists):
            break
    np.testing.assert_allclose(got.T_middle_stamp[0], exp(delay * TWIST), atol=1e-12)


def test_a_late_stamp_is_not_awaited_once_odometry_stops():
    synchroniser = fed(np.linspace(0.0, 1.0, 11))
    waiting = sweeps([0.95], stamps=[5.0], order=[8])
    newest = 9
    assert len(synchroniser.feed(*NOTHING, waiting, newest + MAX_WAIT - 1).twists) == 0
    assert len(synchroniser.feed(*NOTHING, waiting, newest + MAX_WAIT).twists) == 1


def test_an_early_stamp_is_reached_backwards():
    """A sweep of 0.2 s stamped at its first beam: its stamp is 0.1 s before its middle."""
    got = used(fed(np.linspace(0.0, 1.0, 11)), sweeps([0.4], [0.6]))
    np.testing.assert_allclose(got.motions.d_pose[0], exp(0.5 * TWIST), atol=1e-12)
    np.testing.assert_allclose(got.T_middle_stamp[0], exp(-0.1 * TWIST), atol=1e-12)
    assert np.trace(got.stamp_covariance[0]) == pytest.approx(0.1 * np.trace(Q), rel=0.01)


def test_without_motion_over_a_sweep_its_twist_is_the_newest():
    synchroniser = fed([0.0, 0.1, 0.2])
    np.testing.assert_allclose(
        used(synchroniser, sweeps([3.0], [3.1])).twists[0], TWIST, atol=1e-12
    )
    assert not used(Synchroniser(), sweeps([3.0], [3.1])).twists.any()


def test_unusable_sweeps_are_skipped_and_take_no_motion():
    synchroniser = fed(np.linspace(0.0, 1.0, 11))
    both = sweeps([0.35, 0.3])._replace(usable=np.array([False, True]))
    got = used(synchroniser, both)
    np.testing.assert_allclose(got.motions.d_pose[1], exp(0.3 * TWIST), atol=1e-12)
    np.testing.assert_allclose(synchroniser.ahead().d_pose, exp(0.7 * TWIST), atol=1e-12)


def test_odometry_restarts_after_an_unknown_motion():
    """Time goes on, so that sweeps are not kept waiting; the motion is lost."""
    synchroniser = fed([0.0, 1.0])
    stamps = np.array([2.0])
    got = synchroniser.feed(np.array([1]), unknown_motions(stamps), sweeps([2.0], order=[2]), 2)
    np.testing.assert_allclose(got.motions.d_pose[0], exp(TWIST), atol=1e-12)


def test_motion_without_sweeps_takes_bounded_memory():
    stamps = 0.01 * np.arange(1001)
    whole, folded = Synchroniser(), Synchroniser(max_motions=50)
    size = folded._state[0].nbytes
    for k in range(1000):
        motion = moving(stamps[k : k + 2])
        for synchroniser in (whole, folded):
            synchroniser.feed(np.array([k]), motion, sweeps([]), k)
    assert folded._state[0].nbytes == size
    assert folded._state[1][1] <= 51
    a, b = (used(synchroniser, sweeps([9.995])).motions.row(0) for synchroniser in (whole, folded))
    np.testing.assert_allclose(b.d_pose, a.d_pose, atol=1e-12)
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-9)
    assert b.duration == pytest.approx(a.duration)


@pytest.mark.parametrize("begin", [1.0, 0.95, 1.03])
def test_a_sweep_that_overlaps_the_last_one_is_carried_to_its_stamp_all_the_same(begin):
    """The same scan twice, and the sweeps of a second lidar: their first half is used up."""
    begins = [1.0, begin]
    got = used(fed(np.linspace(0.0, 5.0, 26)), sweeps(begins, ends=[1.1, begin + 0.12]))
    for k, half in enumerate((0.05, 0.06)):
        np.testing.assert_allclose(got.T_middle_stamp[k], exp(-half * TWIST), atol=1e-12)
