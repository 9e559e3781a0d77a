"""Health: why a pose cannot be trusted, and that it does not matter how a log is cut."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.sensing import at_rest

from impslam.health import (
    AMBIGUOUS,
    ASSUMED,
    CONTRADICTED,
    DEGRADED,
    ELSEWHERE,
    MISTIMED,
    NONE,
    OPEN,
    STALLED,
    TRACKING,
    UNEXPLAINED,
    UNPLACED,
    Health,
    LogFault,
    describe,
    silent_time,
)
from impslam.map import PathRows, Revision
from impslam.observers.health import HealthMonitor
from impslam.types import Increment, Match, Observation

STILL = at_rest(0.0)


def watch(spreads, cuts, *, valid=None, reasons=None, located=None, monitor=None, moved=None):
    """Let a robot drive 1 m a scan with these position variances; return the monitor's health.

    `moved` are those of the motion since the keyframe, if they are not the same.
    """
    n = len(spreads)
    poses = np.column_stack((np.arange(n), np.zeros((n, 2)))).astype(float)
    covariances, motions = (
        np.array(variances)[:, None, None] * np.full((3, 3), 0.5)
        for variances in (spreads, moved or spreads)
    )
    valid = np.ones((n, 3), bool) if valid is None else valid
    reasons = np.array([NONE] * n if reasons is None else reasons, np.int8)
    located = np.zeros(n, bool) if located is None else located
    monitor = monitor or HealthMonitor()
    for a, b in zip((0, *cuts), (*cuts, n), strict=True):
        rows = slice(a, b)
        track = SimpleNamespace(
            sweeps=SimpleNamespace(scans=SimpleNamespace(valid=valid)),
            rows=rows,
            reasons=reasons[rows],
            amounts=0.1 * reasons[rows],
            located=located[rows],
            T_anchor_base=poses[rows],
            covariance=motions[rows],
        )
        path = PathRows(10.0 + np.arange(n)[rows], poses[rows], covariances[rows], poses[rows])
        monitor.follow(track, path)
    return monitor.health


def revise(monitor, ids, motion=None, variance=0.0, **facts):
    """Let a keyframe, in which nothing is seen, revise the poses of keyframes.

    With a motion, it is not located; `variance` is that of its x and y in the map.
    """
    n = len(ids)
    keyframe = SimpleNamespace(
        scan=None, reason=NONE, amount=0.0, located=motion is None, lost=False, observations=(),
        motion=motion or STILL,
    )  # fmt: skip
    spread = np.diag([variance, variance, 0.0])[None]
    path = PathRows(np.array([14.0]), np.zeros((1, 3)), spread, np.zeros((1, 3)))
    revision = Revision(np.array(ids), np.zeros((n, 3)), np.zeros((n, 3, 3)), **facts)
    monitor.revise(keyframe, revision, path)


def match_landmarks(monitor, variance, walls, driven=0.1):
    """Let a keyframe match a point, or walls of a corridor, with so much variance of its position.

    `driven` is that of the motion since the last keyframe.
    """
    along = np.array([[0.0, 1.0], [4.0, 1.0]])
    seen = [
        Observation("wall", np.zeros(2), np.eye(2), None, np.add(along, [0.0, y])) for y in (0, -2)
    ]
    if not walls:
        seen = [Observation("corner", np.array([2.0, 1.0]), np.eye(2))]
    matches = tuple(Match(i, i, np.zeros(2), np.eye(2), 1.0) for i in range(len(seen)))
    keyframe = SimpleNamespace(
        scan=None, reason=NONE, amount=0.0, located=False, lost=False, observations=seen,
        motion=replace(STILL, covariance=np.diag([driven, 0.0, 0.0])),
    )  # fmt: skip
    covariance = np.diag([variance, 0.0, 0.0])[None]
    path = PathRows(np.array([14.0]), np.zeros((1, 3)), covariance, np.zeros((1, 3)))
    monitor.revise(keyframe, Revision(np.array([4]), np.zeros((1, 3)), covariance, matches), path)


def why(health):
    """Return the reason of the newest scan."""
    return describe(int(health.reasons[-1]), float(health.amounts[-1]))


@pytest.mark.parametrize("cuts", [(), (1,), (1, 2, 3, 4), (3,)])
def test_growth_counts_from_the_first_pose_however_the_log_is_cut(cuts):
    health = watch([9.0, 9.04, 9.09, 9.16, 9.0], cuts)
    (span,) = health.spans()
    assert (span.begin, span.end, span.scans, span.state) == (12.0, 13.0, 2, "DEGRADED")
    assert span.description == "no known feature was seen for 3.0 m; the position is uncertain"
    assert health.counts() == {"TRACKING": 3, "DEGRADED": 2, "LOST": 0}
    assert why(health) == ""


def test_the_most_severe_reason_is_reported():
    blind, doubt = np.zeros((3, 3), bool), [STALLED] * 3
    assert "not finite" in why(watch([1.0, 1.0, np.inf], (), valid=blind, reasons=doubt))
    assert "no known feature was seen" in why(watch([0.0, 1.0, 1.0], (), reasons=doubt))
    assert "the wheels turn" in why(watch([0.0, 0.0, 0.0], (), valid=blind, reasons=doubt))
    assert "the lidar sees nothing" in why(watch([0.0, 0.0, 0.0], (), valid=blind))
    assert "40 % of the scan" not in why(watch([0.0, 9.0], (), reasons=[NONE, OPEN]))
    assert watch([0.0, 0.0, 0.0], ()).summary == "TRACKING throughout"


@pytest.mark.parametrize("cuts", [(), (1,), (1, 2)])
def test_a_problem_of_the_whole_run_is_reported_for_scans_without_a_worse_one(cuts):
    monitor = HealthMonitor(LogFault(MISTIMED, 0.3))
    health = watch([0.0] * 3, cuts, reasons=[NONE, STALLED, NONE], monitor=monitor)
    assert health.reasons.tolist() == [MISTIMED, STALLED, MISTIMED]
    assert health.counts() == {"TRACKING": 0, "DEGRADED": 3, "LOST": 0}
    assert "0.30 s late" in why(health)


@pytest.mark.parametrize("cuts", [(), (2,), (1, 2, 3, 4)])
def test_growth_since_the_last_match_counts(cuts):
    """Two located scans start afresh; 2 m after the second, 0.3 m are uncertain again."""
    located = np.array([False, True, True, False, False])
    (span,) = watch([9.0, 9.5, 10.0, 10.04, 10.09], cuts, located=located).spans()
    assert (span.begin, span.scans) == (14.0, 1)
    assert span.description == "no known feature was seen for 2.0 m; the position is uncertain"


@pytest.mark.parametrize("cuts", [(), (2,), (1, 2, 3)])
def test_a_lost_robot_stays_lost_until_a_place_is_recognised(cuts):
    monitor = HealthMonitor()
    health = watch([0.0] * 4, cuts, reasons=[NONE, UNEXPLAINED, ELSEWHERE, NONE], monitor=monitor)
    assert health.states.tolist() == [0, 1, 2, 2]
    assert why(health) == describe(ELSEWHERE, 0.1 * ELSEWHERE)
    for ids, placed, state in (([4], False, 2), ([3, 4], False, 2), ([3, 4], True, 0)):
        revise(monitor, ids, placed=placed)
        assert monitor.health.states[-1] == state


def test_corridor_walls_do_not_undo_the_growth_of_uncertainty():
    monitor = HealthMonitor()
    for variance, walls in ((0.01, False), (0.04, True), (0.09, True), (0.09, True)):
        match_landmarks(monitor, variance, walls)
    assert monitor.health.states.tolist() == [0, 0, 1, 1]


def test_landmarks_added_since_do_not_undo_the_growth_of_uncertainty():
    """They were begun since then; one from before makes the position sure again."""
    monitor = HealthMonitor()
    for variance in (0.01, 0.05, 0.2, 0.2, 0.05):
        match_landmarks(monitor, variance, walls=False)
    assert monitor.health.states.tolist() == [0, 0, 1, 1, 0]


def test_a_small_motion_far_from_the_start_is_no_growth():
    """There the heading's error at the start moves the position by much."""
    monitor = HealthMonitor()
    for i in range(20):
        match_landmarks(monitor, 100.0 + 0.1 * i, walls=False, driven=1e-4)
    assert monitor.health.counts()["DEGRADED"] == 0


def drive(monitor, heading_variance, steps, variance=100.0):
    """Let a robot drive keyframes 1 m apart, unmatched, while its variance in the map changes much."""
    motion = Increment(0.0, np.array([1.0, 0.0, 0.0]), np.diag([0.0, 0.0, heading_variance]))
    for k in range(steps):
        revise(monitor, [4], motion=motion, variance=variance + k)
    return monitor.health.states.tolist()


def test_the_growth_is_that_of_the_motion_since_the_last_match():
    assert drive(HealthMonitor(), heading_variance=0.0, steps=9) == [0] * 9
    # k steps turn by errors of variance v each: the position gains v * (1 + 4 + ... + (k - 1)^2)
    k = np.arange(9)
    grown = 0.0025 * np.array([np.sum(np.arange(n) ** 2) for n in k]) > 0.25**2
    assert drive(HealthMonitor(), heading_variance=0.0025, steps=9) == [0, *grown[1:].astype(int)]
    assert grown.any()
    assert drive(HealthMonitor(), heading_variance=0.0025, steps=9, variance=1.0)[-1] == 1


def test_a_match_of_a_track_restarts_the_growth_at_the_keyframe_before_it():
    monitor = HealthMonitor()
    drive(monitor, heading_variance=0.0025, steps=9)
    located = np.array([False, True, False])
    health = watch([300.0, 300.0, 310.0], (), located=located, monitor=monitor, moved=[0.0] * 3)
    assert health.states[-3:].tolist() == [1, 0, 0]


def test_a_place_assumed_from_odometry_is_reported_until_one_is_recognised():
    monitor = HealthMonitor()
    for assumed in (False, True, True, False):
        revise(monitor, [4], assumed=assumed)
    assert monitor.health.reasons.tolist() == [NONE, ASSUMED, ASSUMED, NONE]


def test_a_robot_where_the_map_contradicts_the_scans_is_degraded():
    monitor = HealthMonitor()
    for contradicted in (False, True, True, False):
        revise(monitor, [4], contradicted=contradicted)
    assert monitor.health.reasons.tolist() == [NONE, CONTRADICTED, CONTRADICTED, NONE]
    assert monitor.health.states.tolist() == [TRACKING, DEGRADED, DEGRADED, TRACKING]


def test_scans_that_fit_elsewhere_are_degraded():
    monitor = HealthMonitor()
    for fits_elsewhere in (False, True, True, False):
        revise(monitor, [4], fits_elsewhere=fits_elsewhere)
    assert monitor.health.reasons.tolist() == [NONE, AMBIGUOUS, AMBIGUOUS, NONE]
    assert monitor.health.states.tolist() == [TRACKING, DEGRADED, DEGRADED, TRACKING]


def test_a_robot_with_unknown_place_in_the_map_is_lost():
    monitor = HealthMonitor()
    for ids, placed in (([4], False), ([5], False), ([3, 4, 5], np.array([True, True, True]))):
        revise(monitor, ids, placed=placed)
    assert monitor.health.reasons.tolist() == [UNPLACED, UNPLACED, NONE]


def test_spans_report_the_longest_distance_and_the_smallest_share():
    reasons = np.array([OPEN, OPEN, NONE, UNEXPLAINED, UNEXPLAINED], np.int8)
    health = Health(100.0 + np.arange(5.0), reasons, np.array([1.0, 2.0, 0.0, 0.12, 0.3]))
    assert [span.description for span in health.spans()] == [
        "no feature along the corridor for 2.0 m",
        "only 12 % of the scan fits the map; the map is not updated",
    ]
    states = "TRACKING at 1 scans, DEGRADED at 4 scans"
    assert health.summary.startswith(states + "; the longest begins 0.0 s after the start: no")
    assert health.summary.endswith("at the end DEGRADED: " + list(health.spans())[1].description)


def test_the_state_at_the_end_is_not_better_without_scans():
    reasons = np.array([OPEN, NONE, NONE, NONE], np.int8)
    health = Health(np.arange(4.0), reasons, np.ones(4), silent=9.0)
    assert health.at_end == "DEGRADED"
    assert health._replace(silent=0.0).summary.endswith("corridor for 1.0 m; TRACKING at the end")
    assert "corridor for 1.0 m; at the end DEGRADED: no scan in the last 9 s" in health.summary
    reasons[-1] = ELSEWHERE
    assert "; at the end LOST: no scan in the last 9 s" in health.summary
    assert health.summary.count("at the end") == 1


def test_the_longest_span_begins_after_the_time_before_a_clock_stepped_back():
    stamps = np.array([500.0, 501.0, 502.0, 100.0, 101.0, 102.0])
    reasons = np.array([NONE, NONE, NONE, NONE, OPEN, OPEN], np.int8)
    assert "the longest begins 3.0 s after the start" in Health(stamps, reasons, np.ones(6)).summary
    assert "begins 0.0 s after" in Health(stamps, reasons[::-1], np.ones(6)).summary


def test_time_without_scans_counts_if_the_position_has_become_uncertain():
    def after(sigma, seconds):
        return Increment(20.0, np.zeros(3), np.diag([sigma**2, 0.0, 0.0]), seconds)

    times = [silent_time(after(*one)) for one in ((0.3, 9.0), (0.2, 9.0), (0.3, np.nan))]
    assert times == [9.0, 0.0, 0.0]


def test_one_reason_throughout_is_said_once():
    health = Health(np.arange(3.0), np.full(3, OPEN, np.int8), np.array([1.0, 2.0, 0.5]))
    assert health.summary == "DEGRADED throughout: " + describe(OPEN, 2.0)
