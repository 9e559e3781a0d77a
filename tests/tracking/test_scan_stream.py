"""Scans that are repeated bit for bit, and stamps that run back and forth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

from impslam.health import DISORDERED, NONE, REPEATED
from impslam.sources.base import Problems
from impslam.tracking.scan_stream import check_stream, initial_stream_state
from impslam.tracking.screening import Screening
from impslam.types import Increment

ANGLES = np.linspace(-1.0, 1.0, 20)


def check(ranges, stamps=None, distance=0.03, cuts=()):
    m, known = len(ranges), initial_stream_state(ranges.shape[1])
    stamps = 0.1 * np.arange(m) if stamps is None else np.asarray(stamps, float)
    d_pose = np.tile([distance, 0.0, 0.0], (m, 1))
    parts = [
        check_stream(stamps[a:b], ranges[a:b], d_pose[a:b], known)
        for a, b in pairwise([0, *cuts, m])
    ]
    return np.concatenate(parts)


def noisy(m, seed=0):
    return 3.0 + 0.01 * np.random.default_rng(seed).standard_normal((m, len(ANGLES)))


@pytest.mark.parametrize("cuts", [(), (1, 2, 9), range(1, 30)])
def test_a_scan_that_repeats_while_odometry_moves_is_found_however_the_log_is_cut(cuts):
    ranges = noisy(30)
    ranges[10:25] = ranges[10]
    ranges[:, 3] = np.nan  # NaN equals itself bit for bit
    found = check(ranges, cuts=cuts)
    assert (found[:14] == NONE).all()  # 10 cm may go by within the resolution of ranges
    assert (found[14:25] == REPEATED).all()
    assert (found[25:] == NONE).all()


def test_a_stationary_robot_may_see_equal_scans():
    assert not check(np.tile(noisy(1), (50, 1)), distance=0.0).any()


def test_one_beam_that_differs_is_enough():
    ranges = np.tile(noisy(1), (50, 1))
    ranges[:, 5] += 1e-9 * np.arange(50)
    assert not check(ranges).any()


def test_stamps_that_run_backward_or_in_any_order_are_reported():
    back = check(noisy(50), -0.1 * np.arange(50))
    assert (back[5:] == DISORDERED).all()
    order = np.lexsort((np.random.default_rng(1).random(50), np.arange(50) // 5))
    shuffled = check(noisy(50), 0.1 * order)
    assert (shuffled[10:] == DISORDERED).mean() > 0.7


def test_a_stamp_that_runs_back_now_and_then_is_none():
    stamps = 0.1 * np.arange(200.0)
    stamps[np.random.default_rng(2).random(200) < 0.05] -= 0.3
    assert not check(noisy(200), stamps).any()


@pytest.mark.parametrize("sees", [False, True])
def test_scans_in_which_the_lidar_sees_nothing_are_not_repeated(sees):
    empty = cast(room(-3.0, 6.0, -2.0, 2.5), angles=ANGLES).scan
    empty = replace(empty, valid=np.full(len(ANGLES), sees))
    increments = [
        Increment(0.1 * k, np.array([0.03, 0.0, 0.0]), np.zeros((3, 3)), 0.1) for k in range(30)
    ]
    sweeps = sweeps_of([empty] * 30, [i.stamp for i in increments])
    problems = Problems()
    screened = Screening().screen(motions_of(increments), sweeps, problems)
    assert (REPEATED in screened.reasons) == sees
    assert ("repeated scan" in problems.counts) == sees
