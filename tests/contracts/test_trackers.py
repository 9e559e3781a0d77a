"""What every tracker guarantees: any cutting, exact drives, the keyframe gate, honest covariances."""

import math
from functools import cache

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

from impslam.columns import Sweeps
from impslam.component import components
from impslam.geometry.se2 import between, compose, exp
from impslam.health import NONE, SKIPPED, UNEXPLAINED
from impslam.tracking.base import KeyframeGate
from impslam.types import Increment

ROOM = room(-2.0, 3.5, -1.5, 2.2)
PERIOD = 0.1  # s
SWEEPS = 40
STEP = exp(np.array([0.04, 0.0, 0.05]))
SPREAD = np.diag([4e-6, 2e-6, 1e-5])
GATE = KeyframeGate(distance=0.15, angle=math.inf, seconds=math.inf)


@cache
def scene():
    """Return scans (SWEEPS) of a room from an arc, noiseless, and the poses."""
    poses = [np.zeros(3)]
    for _ in range(SWEEPS - 1):
        poses.append(compose(poses[-1], STEP))
    angles = np.linspace(-2.0, 2.0, 180)
    return [cast(ROOM, pose=pose, angles=angles).scan for pose in poses], poses


def driven(step=STEP, spread=SPREAD):
    """Return motions and sweeps of the scene, with odometry that reports `step`."""
    stamps = PERIOD * np.arange(SWEEPS)
    first = Increment(0.0, np.zeros(3), np.zeros((3, 3)), 0.0)
    increments = [first, *(Increment(t, step, spread, PERIOD) for t in stamps[1:].tolist())]
    return motions_of(increments), sweeps_of(scene()[0], stamps)


@pytest.fixture(params=sorted(components("tracker")))
def make(request):
    """Return a function that makes a tracker ready for the first sweep."""

    def make(gate=GATE, start=(0.0, 0.0, 0.0)):
        tracker = components("tracker")[request.param]()
        tracker.start(np.array(start), gate)
        return tracker

    return make


def keyframes(tracks):
    return [track.keyframe for track in tracks if track.keyframe is not None]


def test_any_cutting_gives_the_same_bytes(make):
    """Also with odometry that reports half of the distance, so that the scans contradict it."""
    for step in (STEP, STEP * [0.5, 1.0, 1.0]):
        motions, sweeps = driven(step)
        found = []
        for cut in (1, 7, SWEEPS):
            tracker, rows, keys = make(), [], []
            for k in range(0, SWEEPS, cut):
                part = slice(k, k + cut)
                for track in tracker.follow(motions.take(part), sweeps.take(part)):
                    columns = track.T_anchor_base, track.covariance, track.odometry
                    for m, stamp in enumerate(track.stamps):
                        rows.append((track.anchor, stamp, *(c[m].tobytes() for c in columns)))
                    if track.keyframe is not None:
                        key = track.keyframe
                        values = key.motion.d_pose, key.motion.covariance, key.odometry
                        keys.append((key.id, key.stamp, *(v.tobytes() for v in values)))
            found.append(
                (
                    rows,
                    keys,
                    tracker.motion_since_keyframe[0].tobytes(),
                    dict(tracker.problems.counts),
                )
            )
        assert found[0] == found[1] == found[2]
        assert len(found[0][1]) >= 5
        assert bool(found[0][3]) == (step is not STEP)


def test_a_noiseless_drive_is_exact(make):
    """To a millimetre and a tenth of a degree, at every sweep: matching leaves what it cannot see."""
    tracker, poses = make(), scene()[1]
    key, k = np.zeros(3), 0
    for track in tracker.follow(*driven()):
        for T in track.T_anchor_base:
            off = between(poses[k], compose(key, T))
            assert math.hypot(off[0], off[1]) < 2e-3
            assert abs(off[2]) < 2e-3
            k += 1
        if track.keyframe is not None:
            key = compose(key, track.keyframe.motion.d_pose)
            np.testing.assert_allclose(key, poses[k], atol=2e-3)
            k += 1
    assert k == SWEEPS
    assert not tracker.problems.counts


@pytest.mark.parametrize(
    ("gate", "every"),
    [
        (KeyframeGate(distance=0.15, angle=math.inf, seconds=math.inf), 4),
        (KeyframeGate(distance=math.inf, angle=0.12, seconds=math.inf), 3),
        (KeyframeGate(distance=math.inf, angle=math.inf, seconds=0.45), 5),
        (KeyframeGate(distance=0, angle=math.inf, seconds=math.inf), 1),
        (KeyframeGate(distance=math.inf, angle=math.inf, seconds=math.inf), SWEEPS),
    ],
    ids=["distance", "angle", "seconds", "each", "never"],
)
def test_keyframes_come_after_distance_turn_or_time(make, gate, every):
    """The first sweep is one always."""
    tracks = list(make(gate).follow(*driven()))
    rows = [k.row for k in keyframes(tracks)]
    assert rows == list(range(0, SWEEPS, every))
    assert [k.id for k in keyframes(tracks)] == list(range(len(rows)))
    assert [t.anchor for t in tracks] == [-1, *range(len(rows))][: len(tracks)]


def test_unused_keyframes_lose_no_motion_and_count_none_twice(make):
    """Keyframes' motions begin where the one before ended, whatever became of it."""
    motions, sweeps = driven()
    tracker, moved = make(), np.zeros(3)
    duration = 0.0
    for key in keyframes(tracker.follow(motions, sweeps)):
        moved = compose(moved, key.motion.d_pose)
        duration += key.motion.duration
        np.testing.assert_allclose(moved, scene()[1][key.row], atol=2e-3)
        assert duration == pytest.approx(PERIOD * key.row)
    np.testing.assert_allclose(
        compose(moved, tracker.motion_since_keyframe[0]), scene()[1][-1], atol=2e-3
    )


def test_covariances_are_symmetric_and_grow_from_nothing(make):
    """Positive semidefinite, of odometry that calls itself perfect and of one that may be off.

    The error of the newest match replaces that of the one before, and falls where a scan shows more. The
    drift of matched motion only grows.
    """
    for spread in (SPREAD, np.zeros((3, 3)), 1e-2 * np.eye(3)):
        tracker = make()
        for track in tracker.follow(*driven(spread=spread)):
            P = track.covariance
            np.testing.assert_array_equal(P, P.swapaxes(1, 2))
            if len(P):
                assert np.linalg.eigvalsh(P).min() >= -1e-15
                variances = np.diagonal(P, axis1=1, axis2=2)
                if tracker.matches_scans:
                    of_step = np.diag(tracker.drift.covariance(math.hypot(*STEP[:2]), STEP[2]))
                    steps = 0.99 * np.arange(1, len(P) + 1)[:, None]  # matches err by 1 % of a step
                    assert (variances > steps * of_step).all()
                else:
                    assert (np.diff(variances.sum(axis=1)) >= -1e-12).all()
            if track.keyframe is not None:
                of_key = track.keyframe.motion.covariance
                np.testing.assert_array_equal(of_key, of_key.T)
                assert np.linalg.eigvalsh(of_key).min() >= -1e-15


def test_a_sensor_without_scans_leaves_odometry_as_it_is(make):
    motions, sweeps = driven(STEP * [0.5, 1.0, 1.0])
    blind = Sweeps(
        "posts", sweeps.columns, sweeps.middles, sweeps.twists, sweeps.T_middle_stamp,
        sweeps.stamp_covariance, None,
    )  # fmt: skip
    each = KeyframeGate(distance=0, angle=math.inf, seconds=math.inf)
    tracker = make(each)
    keys = keyframes(tracker.follow(motions, blind))
    assert [k.row for k in keys] == list(range(SWEEPS))
    np.testing.assert_allclose([k.motion.d_pose for k in keys], motions.d_pose, atol=1e-15)
    np.testing.assert_allclose([k.motion.covariance for k in keys], motions.covariance, atol=1e-18)
    assert not tracker.problems.counts


def test_the_poses_of_a_track_compose_to_the_keyframe(make):
    """With a keyframe per sweep, single motions add up to the tracks of a wide gate."""
    each = KeyframeGate(distance=0, angle=math.inf, seconds=math.inf)
    steps = [k.motion.d_pose for k in keyframes(make(each).follow(*driven()))]
    row = 0
    for track in make().follow(*driven()):
        pose = np.zeros(3)
        for T in track.T_anchor_base:
            pose = compose(pose, steps[row])
            np.testing.assert_allclose(T, pose, atol=1e-12)
            row += 1
        if track.keyframe is not None:
            pose = compose(pose, steps[row])
            np.testing.assert_allclose(track.keyframe.motion.d_pose, pose, atol=1e-12)
            row += 1
    assert row == SWEEPS


def test_odometry_is_handed_on_beside_the_motion(make):
    """Dead reckoning from the start, whatever the scans show."""
    short, start = STEP * [0.5, 1.0, 1.0], np.array([2.0, -1.0, 3.0])
    reckoned = [start]
    for _ in range(SWEEPS - 1):
        reckoned.append(compose(reckoned[-1], short))
    tracker, found = make(start=start), []
    for track in tracker.follow(*driven(short)):
        found += list(track.odometry)
        if track.keyframe is not None:
            found.append(track.keyframe.odometry)
    np.testing.assert_allclose(found, reckoned, atol=1e-12)
    np.testing.assert_allclose(tracker.odometry, reckoned[-1], atol=1e-12)


def test_a_log_with_a_scan_every_few_seconds_has_no_gaps(make):
    """Odometry covers the time between the scans."""
    motions, sweeps = driven()
    slow = motions._replace(duration=50.0 * motions.duration, stamps=50.0 * motions.stamps)
    tracks = list(make().follow(slow, sweeps))
    found = [int(r) for track in tracks for r in track.reasons]
    found += [key.reason for key in keyframes(tracks)]
    assert found.count(SKIPPED) <= 1  # the first one, when nothing is usual yet


def test_motion_during_a_gap_is_reported(make):
    motions, sweeps = driven()
    for seconds, distance, reason in ((10.0, 1.0, SKIPPED), (10.0, 0.0, NONE), (1.0, 1.0, NONE)):
        duration, d_pose = motions.duration.copy(), motions.d_pose.copy()
        duration[20], d_pose[20] = seconds, [distance, 0.0, 0.0]
        changed = motions._replace(duration=duration, d_pose=d_pose)
        found = {}
        for track in make().follow(changed, sweeps):
            found |= dict(zip(range(track.rows.start, track.rows.stop), track.reasons, strict=True))
            if track.keyframe is not None:
                found[track.keyframe.row] = track.keyframe.reason
        # The scan does not show the motion: to a tracker that matches scans, it does not fit either.
        assert (found[20] in (SKIPPED, UNEXPLAINED)) == (reason == SKIPPED)
