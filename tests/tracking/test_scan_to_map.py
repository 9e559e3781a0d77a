"""Scans matched with the last metres: exact motion, learned odometry, consistent covariances."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.extractors.scans import URG_ANGLES, cast, room, with_ranges
from tests.sensing import joined
from tests.tracking.sweeps import motions_of, steps, sweeps_of

from impslam.geometry.algebra import rotate_covariance
from impslam.geometry.se2 import between, compose
from impslam.health import NONE, OPEN, PUSHED, SLIPPED
from impslam.noise import UNKNOWN, MotionNoise
from impslam.tracking.base import KeyframeGate
from impslam.tracking.frozen import remains_frozen
from impslam.tracking.fusion import SPEED_SIGMA
from impslam.tracking.learned_odometry import START
from impslam.tracking.match_information import (
    NORMAL_ERROR,
    NORMAL_SIGMA,
    hold_along,
    information,
    remove_spurious,
)
from impslam.tracking.scan_to_map import ScanToMap
from impslam.types import Increment

BOX = room(1.6, 2.3, 0.9, 1.5)[:, ::-1]
ROOM = np.concatenate((room(-3.0, 4.0, -2.5, 3.2), BOX))
POSTS = np.array([[1.5, -1.0, 0.03], [-1.0, -1.8, 0.03], [0.8, 2.4, 0.2]])
CORRIDOR = np.array([[[-50.0, 1.0], [50.0, 1.0]], [[50.0, -1.0], [-50.0, -1.0]]])
BARE = {"range_max": 3.0}
"""Beyond, beams graze the walls of a corridor 2 m wide."""
ALL_ROUND = np.linspace(-math.pi, math.pi, 360, endpoint=False)
NOISE = np.diag([1e-3, 1e-3, 1e-3])
PERIOD = 0.1  # s
NO_DRIFT = MotionNoise(forward=0, sideways=0, turn_per_distance=0, turn_per_turn=0)


def circle(scans, radius=1.2, step=0.06):
    """Return true poses (m, 3) along a circle round the origin."""
    angles = np.arange(scans) * step / radius
    return np.column_stack((radius * np.cos(angles), radius * np.sin(angles), angles + math.pi / 2))


def straight(scans, step=0.06, start=(-1.5, -1.0, 0.2)):
    """Return true poses (m, 3) along a line."""
    pose = np.array(start)
    steps_along = np.column_stack((step * np.arange(scans), np.zeros((scans, 2))))
    return compose(np.tile(pose, (scans, 1)), steps_along)


def odometry_of(poses, error=None):
    """Return the true motions as reported by odometry, with errors (m, 3) added."""
    moves = np.vstack((np.zeros(3), between(poses[:-1], poses[1:])))
    moves[1:] += 0.0 if error is None else error[1:]
    return [Increment(PERIOD * k, moves[k], NOISE * 0.06, PERIOD) for k in range(len(poses))]


def scans_from(poses, lines=ROOM, circles=None, **scan_options):
    """Return the scans from poses, all round by default."""
    scan_options = {"angles": ALL_ROUND, "range_max": 8.0, **scan_options}
    return [cast(lines, circles, pose=pose, **scan_options).scan for pose in poses]


def path(out, start):
    """Return the poses (m, 3) that steps lead to."""
    poses, reference = [], np.array(start, float)
    for k in range(len(out.d_pose)):
        poses.append(compose(reference, out.d_pose[k]))
        if out.reference[k]:
            reference = poses[-1]
    return np.array(poses)


def drive(poses, increments, scans, **parameters):
    """Return the tracker, its steps, and its error (m, 3) in the true frames."""
    tracker = ScanToMap(**parameters)
    out = steps(tracker, increments, scans)
    return tracker, out, between(poses, path(out, poses[0]))


def assert_near(errors, metres, radians):
    assert np.hypot(errors[..., 0], errors[..., 1]).max() < metres
    assert np.abs(errors[..., 2]).max() < radians


def assert_spd(covariance):
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


# --------------------------------------------------------------------------- a room


@pytest.mark.parametrize("laser", [(0.0, 0.0, 0.0), (0.2, -0.1, 2.0)])
@pytest.mark.parametrize("upside_down", [False, True])
def test_a_lap_is_followed_without_drift(rng, laser, upside_down):
    """Odometry is off by 2 cm and 0.02 rad at each step; 7.5 m later the pose is right."""
    poses = circle(126)
    error = rng.uniform(-1, 1, (126, 3)) * [0.02, 0.02, 0.02]
    scans = scans_from(poses, laser=np.array(laser), upside_down=upside_down)
    _, out, off = drive(poses, odometry_of(poses, error), scans)
    assert_near(off, 0.015, 0.006)
    assert out.located[1:].all()
    assert not out.reasons.any()
    for covariance in out.covariance[1:]:
        assert_spd(covariance)


@pytest.mark.parametrize("error", [(0.1, 0, 5), (-0.1, 0, -5), (0, 0.1, -5), (0, -0.1, 5)])
def test_a_known_motion_is_recovered_from_a_wrong_prior(error):
    poses = np.array([[0.0, 0.0, 0.0], [0.2, 0.05, 0.15]])
    off = np.array([[0, 0, 0], [error[0], error[1], math.radians(error[2])]])
    _, _, errors = drive(poses, odometry_of(poses, off), scans_from(poses))
    assert_near(errors, 0.003, 0.002)


def test_posts_in_the_room_do_not_harm(rng):
    poses = circle(60)
    error = rng.uniform(-1, 1, (60, 3)) * [0.02, 0.02, 0.02]
    _, _, off = drive(poses, odometry_of(poses, error), scans_from(poses, circles=POSTS))
    assert_near(off, 0.015, 0.006)


def test_noisy_scans_are_followed_within_centimetres(rng):
    """2 cm on every beam, over 6 m."""
    poses = circle(100)
    error = rng.standard_normal((100, 3)) * [0.01, 0.005, 0.01]
    _, out, off = drive(poses, odometry_of(poses, error), scans_from(poses, noise=0.02, rng=rng))
    assert_near(off, 0.05, 0.02)
    assert out.located[1:].all()


@pytest.mark.parametrize("turn", [1.0, -2.5])
def test_the_result_does_not_depend_on_where_the_frame_began(turn):
    """After a turn on the spot of which the robot saw nothing: all is turned, cells fall elsewhere."""
    poses = circle(40)
    scans, increments = scans_from(poses), odometry_of(poses)
    plain = drive(poses, increments, scans)[1]
    blind = with_ranges(scans[0], np.zeros(360))
    first = Increment(-1.0, np.array([0.3, -2.0, turn]), NOISE, 1.0)
    moved = steps(ScanToMap(), [first, *increments], [blind, *scans])
    np.testing.assert_allclose(moved.d_pose[2:], plain.d_pose[1:], atol=4e-3)
    np.testing.assert_allclose(moved.moved[2:], plain.moved[1:], atol=4e-3)
    np.testing.assert_array_equal(moved.located[2:], plain.located[1:])


def test_frames_of_the_scans_do_not_matter():
    """Scans and odometry are relative: where the room lies in the world changes nothing."""
    poses, shift = circle(30), np.array([40.0, -7.0, 2.0])
    walls = compose(shift, np.concatenate((ROOM, np.zeros((*ROOM.shape[:2], 1))), 2).reshape(-1, 3))
    other = scans_from(compose(shift, poses), walls[:, :2].reshape(ROOM.shape))
    one, two = (drive(poses, odometry_of(poses), scans)[1] for scans in (scans_from(poses), other))
    np.testing.assert_allclose(one.d_pose, two.d_pose, atol=1e-5)


# --------------------------------------------------------------------------- batches


@pytest.mark.parametrize("rows", [1, 7])
def test_any_cutting_of_a_log_gives_the_same_bytes(rng, rows):
    poses = circle(40)
    error = rng.uniform(-1, 1, (40, 3)) * [0.02, 0.02, 0.02]
    increments, scans = odometry_of(poses, error), scans_from(poses, noise=0.01, rng=rng)
    found = []
    for size in (rows, 40):
        tracker = ScanToMap()
        tracker.start(np.zeros(3), KeyframeGate(distance=0.4, angle=0.4, seconds=math.inf))
        poses_at, keyframes = [], []
        for a in range(0, 40, size):
            b = slice(a, a + size)
            sweeps = sweeps_of(scans[b], [i.stamp for i in increments[b]])
            for track in tracker.follow(motions_of(increments[b]), sweeps):
                poses_at.append(np.hstack((track.T_anchor_base, track.covariance.reshape(-1, 9))))
                if track.keyframe is not None:
                    motion = track.keyframe.motion
                    keyframes.append((motion.stamp, *motion.d_pose, *motion.covariance.ravel()))
        found.append((np.concatenate(poses_at).tobytes(), np.array(keyframes).tobytes()))
    assert found[0] == found[1]
    assert len(keyframes) == pytest.approx(40 * 0.06 / 0.4, abs=2)


# --------------------------------------------------------------------------- odometry that fails


def test_a_robot_that_moves_while_odometry_is_frozen_is_followed():
    poses = circle(60)
    still = [Increment(PERIOD * k, np.zeros(3), np.zeros((3, 3)), PERIOD) for k in range(60)]
    _, out, off = drive(poses, still, scans_from(poses))
    assert_near(off, 0.08, 0.04)
    assert out.located[5:].all()
    for covariance in out.covariance[out.reference][1:]:
        assert_spd(covariance)


@pytest.mark.parametrize("still", [False, True])
def test_keyframes_come_at_the_distance_of_the_gate_whatever_odometry_reports(still):
    poses = straight(50)
    increments = odometry_of(poses)
    if still:
        increments = [Increment(i.stamp, np.zeros(3), np.zeros((3, 3)), PERIOD) for i in increments]
    out = steps(ScanToMap(), increments, scans_from(poses), limits=(0.3, np.inf, np.inf))
    ends = np.flatnonzero(out.is_keyframe)
    assert 0.06 * np.diff(ends).min() >= 0.24
    assert 0.06 * np.diff(ends).max() <= 0.45
    assert len(ends) == pytest.approx(50 * 0.06 / 0.3, abs=2)


def test_backing_up_that_is_logged_as_forward_is_followed():
    """As reported by encoders without a sign; forward again, odometry is as good as before."""
    forward, back = straight(25), straight(25)[::-1]
    poses = np.vstack((forward, back[1:], forward[1:]))
    increments = [
        i if k == 0 else Increment(i.stamp, np.abs(i.d_pose), i.covariance, PERIOD)
        for k, i in enumerate(odometry_of(poses))
    ]
    _, _, off = drive(poses, increments, scans_from(poses))
    assert_near(off, 0.06, 0.03)


def with_pillars(*positions, depth=0.5):
    """Return the lines of pillars that stand out by `depth` m from both walls of the corridor."""
    frames = [
        [
            [[x, y], [x, (1.0 - depth) * y]],
            [[x, (1.0 - depth) * y], [x + 0.3, (1.0 - depth) * y]],
            [[x + 0.3, (1.0 - depth) * y], [x + 0.3, y]],
        ]
        for x in positions
        for y in (1.0, -1.0)
    ]
    return np.concatenate((CORRIDOR, *frames))


def frozen(poses, first, last):
    """Return the motions of odometry that stands still from one scan to another."""
    still = Increment(0.0, np.zeros(3), np.zeros((3, 3)), PERIOD)
    return [
        replace(still, stamp=i.stamp) if first <= k < last else i
        for k, i in enumerate(odometry_of(poses))
    ]


def silent(poses, covariance=NOISE):
    """Return motions of odometry that is silent for 3 s, and then gives the whole motion at once."""
    increments = odometry_of(poses)
    for k in range(30, 60):
        increments[k] = Increment(increments[k].stamp, np.zeros(3), 0.0 * NOISE, 0.0)
    missed = between(poses[29], poses[60])
    increments[60] = Increment(6.0, missed, covariance, 3.1)
    return increments


def test_a_robot_whose_odometry_freezes_goes_on_through_a_bare_corridor(rng):
    """The scans show that it moves up to the last pillar; there is nothing to see on the next 3 m."""
    poses = straight(200, start=(-4.0, 0.1, 0.0))
    walls = with_pillars(-4.0, -2.5, -1.0)
    scans = scans_from(poses, walls, **BARE, noise=0.01, rng=rng)
    _, out, off = drive(poses, frozen(poses, 30, 150), scans)
    assert not out.located[110:150].any()
    assert (out.reasons[50:150] != NONE).mean() > 0.9
    assert np.abs(off[:, 0]).max() < 0.6
    assert np.abs(np.diff(off[155:, 0])).max() < 0.02


def test_odometry_that_turns_on_the_spot_is_not_frozen():
    state = ScanToMap()._state
    state.frozen.is_frozen[0] = True
    assert remains_frozen(np.zeros(3), state)
    assert not remains_frozen(np.array([0.0, 0.0, 0.5]), state)


def test_odometry_that_froze_in_a_bare_corridor_is_noticed_at_the_next_pillar(rng):
    """It may have been frozen since it stopped, so the covariance includes the motion since then."""
    poses = straight(140, start=(0.0, 0.1, 0.0))
    scans = scans_from(poses, with_pillars(5.0, 7.0), **BARE, noise=0.01, rng=rng)
    _, out, off = drive(poses, frozen(poses, 10, 100), scans)
    assert off[50, 0] < -2.0
    assert (out.reasons[85:100] == PUSHED).any()
    spread = ends(out)[1]
    assert off[-1, 0] ** 2 < 9.0 * spread[0, 0]
    assert np.abs(np.diff(off[90:, 0])).max() < 0.05


@pytest.mark.parametrize("depth", [0.1, 0.2, 0.5])
def test_wheels_that_turn_in_vain_do_not_move_the_robot_where_few_points_tell(rng, depth):
    """Matches with a shallow pillar follow odometry, but no range has changed."""
    poses = np.vstack((straight(60, start=(0.0, 0.1, 0.0)), np.tile((3.54, 0.1, 0.0), (100, 1))))
    scans = scans_from(poses, with_pillars(2.5, 5.0, depth=depth), **BARE, noise=0.01, rng=rng)
    error = np.zeros((160, 3))
    error[60:, 0] = 0.03
    _, _, off = drive(poses, odometry_of(poses, error), scans)
    assert np.abs(off[:, 0]).max() < 0.3


@pytest.mark.parametrize(
    "slip", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.3), (0, 0, -0.3), (0.3, 0.2, 0.3)]
)
def test_a_slip_is_found_again(slip):
    poses, error = circle(40), np.zeros((40, 3))
    error[20] = slip
    _, out, off = drive(poses, odometry_of(poses, error), scans_from(poses))
    assert_near(off[:20], 0.01, 0.005)
    assert_near(off[24:], 0.03, 0.01)
    assert out.reasons[20] == SLIPPED
    assert not np.delete(out.reasons, [19, 20, 21]).any()
    assert out.located[25:].all()


# --------------------------------------------------------------------------- learned odometry


@pytest.mark.parametrize(
    "bias", [(0.04, 0.0, 0.0), (-0.04, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.05), (0, 0, -0.05)]
)
def test_the_bias_of_odometry_is_learned(bias):
    """Turn per distance, scale of turns, scale of distances: the correction is within a fifth."""
    poses = eights(400) if bias[1] else circle(300)
    moves = np.vstack((np.zeros(3), between(poses[:-1], poses[1:])))
    wrong = moves.copy()
    wrong[:, :2] /= 1.0 + bias[2]
    wrong[:, 2] = (moves[:, 2] - bias[0] * wrong[:, 0]) / (1.0 + bias[1])
    tracker, _, _ = drive(poses, odometry_of(poses, wrong - moves), scans_from(poses))
    learned = tracker._state.odometry.bias
    way, turn = wrong[1:, 0], wrong[1:, 2]
    corrected = turn + learned[0] * way + learned[1] * turn
    before, after = np.abs((turn - moves[1:, 2]).mean()), np.abs((corrected - moves[1:, 2]).mean())
    if bias[2]:
        assert learned[2] == pytest.approx(bias[2], abs=0.2 * abs(bias[2]))
    elif bias[0]:
        assert after < 0.2 * before
    else:
        off = corrected - moves[1:, 2]
        assert np.abs(off).mean() < 0.4 * np.abs(turn - moves[1:, 2]).mean()


def eights(scans, radius=0.9, step=0.06):
    """Return true poses (m, 3) along eights: circles to the left and to the right in turn."""
    poses, pose = [], np.array([0.0, -0.5, 0.0])
    per = round(2 * math.pi * radius / step)
    for k in range(scans):
        poses.append(pose)
        pose = compose(pose, np.array([step, 0.0, (1 - 2 * (k // per % 2)) * step / radius]))
    return np.array(poses)


@pytest.mark.parametrize(("metres", "radians"), [(0.03, 0.02), (0.1, 0.08)])
def test_the_noise_of_odometry_is_learned_within_a_factor_of_2(rng, metres, radians):
    """60 m by odometry with such noise per root metre."""
    poses = circle(1000)
    error = rng.standard_normal((1000, 3)) * [metres, metres, radians] * math.sqrt(0.06)
    tracker, _, off = drive(poses, odometry_of(poses, error), scans_from(poses))
    place, heading = np.sqrt(tracker._state.odometry.noise)
    assert 0.5 * metres < place < 2.0 * metres
    assert 0.5 * radians < heading < 2.0 * radians
    assert_near(off, 0.1, 0.04)


def test_it_forgets_its_submaps():
    tracker, poses = ScanToMap(), circle(8)
    scans = scans_from(poses)
    out = steps(tracker, odometry_of(poses), scans)
    filled = tracker._state.submaps.first.size[0]
    tracker.forget()
    assert filled > 0
    assert tracker._state.submaps.first.size[0] == 0
    assert not tracker._seen.get("lidar", scans[0].ranges.size).ranges.any()
    anew = steps(tracker, odometry_of(poses), scans)
    np.testing.assert_allclose(anew.d_pose, out.d_pose, atol=1e-9)


# --------------------------------------------------------------------------- covariance


def ends(out):
    """Return the end of the path and its covariance to first order, in the first frame."""
    T, spread, error = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for k in np.flatnonzero(out.reference):
        error = rotate_covariance(out.error[k], T[2])
        increment = joined(
            Increment(0.0, T, spread), Increment(0.0, out.d_pose[k], out.covariance[k])
        )
        T, spread = increment.d_pose, increment.covariance
    return T, spread + error


def test_claimed_covariances_cover_the_errors_over_5_m():
    """NEES of 20 drives: not above the chi-square bound (99.9 %, 60 degrees of freedom: 99.6)."""
    poses, nees = circle(84), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        error = rng.standard_normal((84, 3)) * [0.03, 0.02, 0.03] * math.sqrt(0.06)
        out = steps(ScanToMap(), odometry_of(poses, error), scans_from(poses, noise=0.02, rng=rng))
        last = np.flatnonzero(out.reference)[-1]
        T, spread = ends(out)
        e = T - between(poses[0], poses[last])
        e[2] = (e[2] + math.pi) % (2 * math.pi) - math.pi
        nees.append(e @ np.linalg.solve(spread, e))
    assert np.sum(nees) < 99.6


def test_the_error_of_matching_does_not_depend_on_the_number_of_scans():
    """Each scan replaces the error of the one before: 61 over 3.6 m are as accurate as 11."""
    poses = circle(61)
    spreads = []
    for every in (1, 6):
        some = poses[::every]
        still = Increment(0.0, np.zeros(3), np.zeros((3, 3)), PERIOD)
        out = steps(ScanToMap(drift=NO_DRIFT), [still, *odometry_of(some)[1:]], scans_from(some))
        spreads.append(np.diag(ends(out)[1]))
    np.testing.assert_allclose(spreads[0], spreads[1], rtol=0.1)


@pytest.mark.parametrize("scans", [60, 600])
def test_along_a_bare_corridor_the_covariance_grows_as_odometry_does(scans):
    """Not less than half of what odometry strays by: that both agree there teaches no noise."""
    rng, sigma = np.random.default_rng(1), 0.05
    poses = straight(scans, start=(0.0, 0.1, 0.0))
    error = rng.standard_normal((scans, 3)) * [sigma, 0.02, 0.02] * math.sqrt(0.06)
    tracker, out, _ = drive(poses, odometry_of(poses, error), scans_from(poses, CORRIDOR, **BARE))
    _, spread = ends(out)
    assert tracker._state.odometry.noise[0] >= START[0] ** 2
    assert spread[0, 0] > 0.25 * sigma**2 * 0.06 * scans
    assert not out.located[5:].any()


@pytest.mark.parametrize("along", [0.1, 0.0, -0.1])
def test_along_a_bare_corridor_the_prior_stands_and_across_it_is_corrected(along):
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.04, 0.05]])
    off = np.array([[0.0, 0.0, 0.0], [along, 0.1, math.radians(5.0)]])
    _, out, errors = drive(poses, odometry_of(poses, off), scans_from(poses, CORRIDOR, **BARE))
    assert np.abs(errors[1, 1:]).max() < 0.01
    assert out.d_pose[1, 0] == pytest.approx(0.3 + along, abs=0.01)
    spread = out.covariance[1] + out.error[1]
    assert spread[1, 1] < 0.1 * spread[0, 0]
    assert not out.located[1]


def test_covariances_are_no_smaller_than_the_drift():
    poses = circle(20)
    for lines in (ROOM, CORRIDOR):
        tracker, out, _ = drive(poses, odometry_of(poses), scans_from(poses * 0.5, lines))
        for d, added, error in zip(out.d_pose[1:], out.covariance[1:], out.error[1:], strict=True):
            drift = tracker.drift.covariance(math.hypot(d[0], d[1]), d[2])
            assert np.linalg.eigvalsh(added + error - drift)[0] > 0.0


def test_each_match_adds_the_drift_of_its_motion():
    poses = circle(20)
    tracker, out, _ = drive(poses, odometry_of(poses), scans_from(poses))
    for d, added in zip(out.d_pose[1:], out.covariance[1:], strict=True):
        drift = tracker.drift.covariance(math.hypot(d[0], d[1]), d[2])
        np.testing.assert_allclose(added, drift, rtol=0.02)


def test_matching_tells_more_than_odometry_alone():
    poses = circle(10)
    _, out, _ = drive(poses, odometry_of(poses), scans_from(poses), drift=NO_DRIFT)
    for covariance in out.covariance[1:] + out.error[1:]:
        assert_spd(covariance)
        assert np.linalg.eigvalsh(covariance)[-1] < 0.02**2


# --------------------------------------------------------------------------- little to match


def test_the_first_scan_returns_the_increment():
    given = Increment(1.0, np.array([0.1, 0.0, 0.1]), NOISE, 1.0)
    out = steps(ScanToMap(), [given], scans_from(np.zeros((1, 3))))
    np.testing.assert_allclose(out.d_pose[0], given.d_pose, atol=1e-15)
    np.testing.assert_allclose(out.covariance[0], given.covariance, atol=1e-12)
    assert out.reference[0]
    assert not out.reasons[0]


@pytest.mark.parametrize("beams", [0, 1, 9])
def test_too_few_points_leave_the_motion_to_odometry(beams):
    poses = circle(2)
    first, second = scans_from(poses)
    few = np.zeros(360, bool)
    few[: 36 * beams : 36] = True
    increments = odometry_of(poses, np.array([[0, 0, 0], [0.05, 0.0, 0.1]]))
    out = steps(ScanToMap(), increments, [first, with_ranges(second, second.ranges, few)])
    np.testing.assert_allclose(out.d_pose[1], increments[1].d_pose, atol=1e-12)
    np.testing.assert_allclose(out.covariance[1], increments[1].covariance, atol=1e-12)
    assert not out.located[1]


def test_blind_scans_are_bridged_by_odometry_and_do_not_lose_the_map(rng):
    poses = circle(60)
    scans = scans_from(poses)
    scans[20:30] = [with_ranges(s, np.zeros(360)) for s in scans[20:30]]
    error = rng.standard_normal((60, 3)) * 0.005
    _, out, off = drive(poses, odometry_of(poses, error), scans)
    assert not out.located[20:30].any()
    assert out.located[31:].all()
    assert_near(off[31:], 0.01, 0.005)


def test_scans_without_beams_leave_the_motion_to_odometry():
    poses = circle(3)
    increments = odometry_of(poses)
    out = steps(ScanToMap(), increments, scans_from(poses, angles=np.empty(0)))
    np.testing.assert_allclose(out.d_pose[1:], [i.d_pose for i in increments[1:]], atol=1e-12)


def test_only_blind_scans_are_odometry():
    poses = circle(30)
    scans = [with_ranges(s, np.zeros(360)) for s in scans_from(poses)]
    _, out, off = drive(poses, odometry_of(poses), scans)
    assert_near(off, 1e-9, 1e-9)
    assert not out.located.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_motion_that_is_not_finite_ends_no_program(value):
    poses = circle(6)
    increments = odometry_of(poses)
    increments[3] = Increment(0.3, np.array([value, 0.0, 0.0]), NOISE, PERIOD)
    assert len(steps(ScanToMap(), increments, scans_from(poses)).d_pose) == 6


def test_a_lidar_of_8_beams_is_odometry_or_better(rng):
    """Too few points to match with: odometry goes on, and claims what odometry claims."""
    poses, error = circle(50), rng.standard_normal((50, 3)) * 0.003
    scans = scans_from(poses, angles=np.linspace(-math.pi, math.pi, 8, endpoint=False))
    increments = odometry_of(poses, error)
    out = steps(ScanToMap(), increments, scans)
    np.testing.assert_allclose(out.moved[1:], [i.d_pose for i in increments[1:]], atol=1e-9)
    assert not out.located.any()
    assert not out.reasons.any()


def test_a_lidar_of_24_beams_does_no_harm(rng):
    poses, error = circle(100), rng.standard_normal((100, 3)) * 0.003
    scans = scans_from(poses, angles=np.linspace(-math.pi, math.pi, 24, endpoint=False))
    _, _, off = drive(poses, odometry_of(poses, error), scans)
    assert_near(off, 0.15, 0.1)


def test_a_scan_of_elsewhere_does_not_locate():
    """Carried into a small closet: the scan fits nothing known, and says so."""
    poses = circle(30)
    scans = scans_from(poses)
    closet = cast(room(-0.5, 0.6, -0.7, 0.4), angles=ALL_ROUND, range_max=8.0).scan
    scans[20:] = [closet] * 10
    _, out, _ = drive(poses, odometry_of(poses), scans)
    assert out.located[1:20].all()
    assert not out.located[20]


def test_back_from_a_blind_drive_beyond_the_map_the_tracker_begins_again():
    """100 m without a scan: the old map is out of reach; what is seen then is matched."""
    poses = circle(60)
    scans, increments = scans_from(poses), odometry_of(poses)
    far = Increment(1.95, np.array([100.0, 0.0, 0.0]), NOISE * 100, 1.0)
    blind = with_ranges(scans[0], np.zeros(360))
    out = steps(
        ScanToMap(), [*increments[:20], far, *increments[20:]], [*scans[:20], blind, *scans[20:]]
    )
    after = between(poses[20:-1], poses[21:])
    np.testing.assert_allclose(out.moved[22:], after, atol=0.02)
    assert out.located[30:].all()


# --------------------------------------------------------------------------- two lidars


def test_two_lidars_are_matched_to_one_map(rng):
    """One ahead, one behind, each sees less than half; sweeps come in turn."""
    poses = circle(80)
    half = np.linspace(-1.4, 1.4, 160)
    lasers = {"front": np.array([0.15, 0.0, 0.0]), "rear": np.array([-0.2, 0.05, math.pi])}
    error = rng.uniform(-1, 1, (80, 3)) * 0.01
    increments, tracker, reached = odometry_of(poses, error), ScanToMap(), [poses[0]]
    for k in range(80):
        name = ("front", "rear")[k % 2]
        scans = scans_from(poses[k : k + 1], angles=half, laser=lasers[name])
        out = steps(tracker, increments[k : k + 1], scans, sensor=name)
        reached.append(compose(reached[-1], out.moved[0]))
    assert_near(between(poses, np.array(reached[1:])), 0.03, 0.015)


def test_a_lidar_whose_beams_change_goes_on():
    poses = circle(20)
    few = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    tracker, increments = ScanToMap(), odometry_of(poses)
    steps(tracker, increments[:10], scans_from(poses[:10]))
    out = steps(tracker, increments[10:], scans_from(poses[10:], angles=few))
    assert out.located.all()
    np.testing.assert_allclose(out.moved, [i.d_pose for i in increments[10:]], atol=5e-3)


def test_a_robot_that_stands_is_not_matched_again():
    """Nothing changes, so nothing is gained; the motion stays that since the last match."""
    poses = np.zeros((10, 3))
    out = steps(ScanToMap(), odometry_of(poses), scans_from(poses))
    assert out.reference.tolist() == [True] + [False] * 9
    assert not out.d_pose.any()
    assert all(a <= b for a, b in pairwise(np.trace(out.covariance, axis1=1, axis2=2)[1:]))


@pytest.mark.parametrize(("degrees", "turn"), [(57.0, 0.14), (360.0, 0.4)])
def test_scans_are_added_before_much_of_the_view_is_new(degrees, turn):
    step, angles = 0.041, np.radians(np.linspace(-0.5 * degrees, 0.5 * degrees, 200))
    poses = np.zeros((50, 3))
    poses[:, 2] = step * np.arange(50)
    tracker, added = ScanToMap(), []
    for increment, scan in zip(odometry_of(poses), scans_from(poses, angles=angles), strict=True):
        steps(tracker, [increment], [scan])
        added.append(tracker._seen.get("lidar", 200).added[2])
    turns = np.diff(np.unique(np.round(added, 2)))
    assert np.ceil(turn / step) * step == pytest.approx(turns, abs=0.015)


# --------------------------------------------------------------------------- no odometry


def unknown(poses):
    """Return the increments of a robot without odometry."""
    return [
        Increment(PERIOD * k, np.zeros(3), np.diag([UNKNOWN] * 3), PERIOD)
        for k in range(len(poses))
    ]


@pytest.mark.parametrize("way", [circle, straight])
def test_a_lidar_alone_follows_the_robot(way):
    poses = way(60)
    _, out, off = drive(poses, unknown(poses), scans_from(poses))
    assert_near(off, 0.02, 0.01)
    assert out.located[2:].all()
    for covariance in out.covariance[1:]:
        assert_spd(covariance)
        assert np.linalg.eigvalsh(covariance)[-1] < 0.05**2


def test_a_lidar_alone_claims_nothing_along_a_bare_corridor():
    poses = straight(60, start=(0.0, 0.1, 0.0))
    _, out, _ = drive(poses, unknown(poses), scans_from(poses, CORRIDOR, **BARE))
    assert not out.located.any()
    assert ((out.covariance + out.error)[1:, 0, 0] > 0.02**2).all()


def test_a_lidar_alone_covers_a_velocity_that_stays_wrong_along_a_bare_corridor():
    """It has always seen the same, and hence believes to stand, while it goes at 0.25 m/s."""
    poses = straight(60, step=0.025, start=(0.0, 0.1, 0.0))
    _, out, off = drive(poses, unknown(poses), scans_from(poses, CORRIDOR, **BARE))
    _, spread = ends(out)
    assert abs(off[-1, 0]) > 1.0
    assert off[-1, 0] ** 2 < 9.0 * spread[0, 0]
    assert spread[0, 0] > 0.9 * (SPEED_SIGMA * 59 * PERIOD) ** 2
    assert out.reasons[-1] == OPEN


def test_a_lidar_alone_keeps_its_velocity_along_a_bare_corridor(rng):
    """Normals of walls whose points scatter by 1 cm are off, which must not stop the robot.

    The wall behind is out of sight after 2 m, the way from there is 2.8 m.
    """
    walls = np.concatenate((CORRIDOR, [[[-1.0, -1.0], [-1.0, 1.0]]]))
    poses = straight(80, start=(0.0, 0.1, 0.0))
    scans = [
        with_ranges(s, np.where(s.valid, s.ranges + 0.01 * rng.standard_normal(360), 0.0))
        for s in scans_from(poses, walls, **BARE)
    ]
    _, out, off = drive(poses, unknown(poses), scans)
    assert out.located[:30].sum() > 25
    assert not out.located[40:].any()
    assert np.abs(off[:, 0]).max() < 1.4
    assert off[-1, 0] ** 2 < 9.0 * ends(out)[1][0, 0]


@pytest.mark.parametrize(
    ("angles", "most"),
    [(ALL_ROUND, 0.1), (URG_ANGLES + math.pi, 0.18), (URG_ANGLES + 2.66, 0.18)],
    ids=["all round", "backward", "askew"],
)
def test_a_bare_corridor_neither_stops_odometry_nor_changes_its_scale(rng, angles, most):
    """Its range limit ends what the lidar shows of the walls, and these ends move with the robot.

    So do those at the edge of the view, close to the robot, where dense beams scatter more than they are
    apart, and single ones are lost.
    """
    poses = straight(300, start=(-20.0, 0.2, 0.0))
    scans = scans_from(poses, CORRIDOR, angles=angles, range_max=5.6, noise=0.01, rng=rng)
    scans = [with_ranges(s, s.ranges, s.valid & (rng.random(len(angles)) > 0.005)) for s in scans]
    tracker, out, off = drive(poses, odometry_of(poses), scans)
    assert not out.located.any()
    assert tracker._state.odometry.bias[2] == 0.0
    assert abs(off[-1, 0]) < most


def test_spurious_information_is_subtracted_from_the_weakest_axis_alone(rng):
    J = rng.standard_normal((40, 3)) * [0.02, 1.0, 2.0]
    H = J.T @ J
    before, after = information(H), H.copy()
    remove_spurious(after)
    weakest, strongest, axis = information(after)
    expected = before[0] - NORMAL_SIGMA**2 * before[1]
    assert weakest == pytest.approx(max(expected, 0.0), abs=1e-9)
    assert strongest == pytest.approx(before[1])
    assert math.sin(axis - before[2]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("axis", [0.0, 0.7, 2.0])
def test_a_match_is_held_back_as_if_it_had_no_spurious_information(axis):
    """Two walls along an axis, whose normals have errors; the same without these, fused with the prior."""
    rms, prior, strongest, seen = 0.02, 900.0, 5e4, 100.0
    along = np.array([math.cos(axis), math.sin(axis), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    spurious = (NORMAL_ERROR * rms) ** 2 * strongest
    H = strongest * np.outer(across, across) + np.diag([0.0, 0.0, 1e5])
    H += (seen + spurious) * np.outer(along, along)
    W, guess = np.array([prior, prior, 1e4]), np.array([1.0, 2.0, 0.3])
    total = seen + spurious
    pose = guess + 0.1 * total / (total + prior) * along + 0.05 * across
    hold_along(H, W, NORMAL_ERROR * rms, guess, pose)
    expected = guess + 0.1 * seen / (seen + prior) * along + 0.05 * across
    np.testing.assert_allclose(pose, expected, atol=1e-12)
    assert along @ H @ along == pytest.approx(seen)
    assert across @ H @ across == pytest.approx(strongest)


def test_a_match_with_spurious_information_only_stays_where_odometry_is():
    H, W = np.diag([10.0, 1e5, 1e5]), np.full(3, 900.0)
    guess, pose = np.zeros(3), np.array([0.05, 0.03, 0.02])
    hold_along(H, W, NORMAL_ERROR * 0.02, guess, pose)
    np.testing.assert_allclose(pose, [0.0, 0.03, 0.02], atol=1e-12)
    assert H[0, 0] == 0.0


def test_a_lidar_alone_goes_on_after_blind_scans():
    """At constant velocity for 0.5 s; the claimed covariance covers what was not seen."""
    poses = circle(60)
    scans = scans_from(poses)
    scans[30:35] = [with_ranges(s, np.zeros(360)) for s in scans[30:35]]
    _, out, off = drive(poses, unknown(poses), scans)
    assert_near(off[36:], 0.05, 0.02)
    assert out.located[36:].all()


def test_a_lidar_alone_goes_on_along_a_wall_whose_ends_are_out_of_sight():
    """Beams at the visible ends of the wall, with noise of 1 % of the range, must not pull the robot.

    In the median of eight drives of 5 m beyond the view of a corner, the error was 2 to 4 m.
    """
    poses = straight(125, start=(0.0, 0.0, 0.0))
    scans = scans_from(poses, room(-1.5, 9.0, -1.2, 6.0), range_max=3.5)
    worst = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        seen = [(s, s.valid & (rng.random(len(s.ranges)) > 0.02)) for s in scans]
        noisy = [
            with_ranges(s, np.where(v, s.ranges * (1 + 0.012 * rng.standard_normal(360)), 0.0), v)
            for s, v in seen
        ]
        _, _, off = drive(poses, unknown(poses), noisy)
        worst.append(np.abs(off[:, 0]).max())
    assert np.median(worst) < 1.0
