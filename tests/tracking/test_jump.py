"""A robot that is carried while its wheels stand still, and one that drives past people."""

import math

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import steps
from tests.tracking.test_contradictions import ANGLES, GEOMETRY, WORLD, scan_at

from impslam.columns import Motions, Scans
from impslam.geometry.se2 import between
from impslam.tracking.beams import Geometry, beam_columns
from impslam.tracking.contradictions import CLEARANCE, free_ranges
from impslam.tracking.jump import (
    MAX_INTERVAL,
    MIN_DOUBTED,
    JumpCheck,
    _is_not_free,
    _view,
    doubted_share,
    find_change,
    no_past,
)
from impslam.tracking.odometry import OdometryTracker
from impslam.tracking.reference_scan import laser_motion, seen_from
from impslam.types import Increment

STEP = 0.03
RATE = 10.0


def person(x, y):
    """Return the sides of a box of 30 cm at (x, y)."""
    offsets = np.array([[0, 0], [0.3, 0], [0.3, 0.3], [0, 0.3]])
    corners = offsets + np.array([x, y])
    return [[corners[k], corners[(k + 1) % 4]] for k in range(4)]


def drive(n=40, start=(-1.0, 0.0, 0.0)):
    """Return poses (n, 3) of a robot that drives ahead."""
    return np.array(start) + STEP * np.arange(n)[:, None] * (np.cos(start[2]), np.sin(start[2]), 0)


def shares(
    poses,
    people=(),
    *,
    odometry=None,
    interval=1.0 / RATE,
    cut=0,
    check=None,
    sensor="a",
    whole=False,
    rates=None,
):
    """Return the shares of scans at true poses; `people` gives the walls that each scan sees as well.

    `rates` are those at which the robot turns during sweeps of 0.1 s.
    """
    rng, m = np.random.default_rng(1), len(poses)
    extra = [people[k] if len(people) else [] for k in range(m)]
    ranges = np.array(
        [scan_at(p, np.array([*WORLD, *e], float)) for p, e in zip(poses, extra, strict=True)]
    )
    ranges += 0.005 * rng.standard_normal(ranges.shape)
    wheels = poses if odometry is None else odometry
    d_pose = np.vstack((np.zeros(3), between(wheels[:-1], wheels[1:])))
    points, directions = np.zeros((m, len(ANGLES), 2)), np.tile(ANGLES + GEOMETRY.laser[2], (m, 1))
    if rates is not None:
        turned = np.outer(rates, np.linspace(-0.05, 0.05, len(ANGLES)))
        directions += turned
        seen = np.arange(len(ANGLES)) + np.rint(turned / GEOMETRY.spacing).astype(int)
        lost = (seen < 0) | (seen >= len(ANGLES))
        ranges = np.take_along_axis(ranges, np.clip(seen, 0, len(ANGLES) - 1), 1)
        ranges[lost] = np.inf
    valid = np.isfinite(ranges)
    check = check or JumpCheck()
    out = []
    for rows in (slice(0, cut), slice(cut, m)) if cut else (slice(0, m),):
        scans = Scans(
            np.arange(m)[rows] * interval, ANGLES, ranges[rows], valid[rows], points[rows],
            directions[rows], points[rows], ranges[rows], 0.0, 30.0, GEOMETRY.laser,
        )  # fmt: skip
        motions = Motions(
            scans.stamps, d_pose[rows], np.zeros((len(d_pose[rows]), 3, 3)),
            np.full(len(d_pose[rows]), interval),
        )  # fmt: skip
        out.append(check.find(motions, beam_columns(scans, len(d_pose[rows])), sensor))
    found, confirmed = (np.concatenate(parts) for parts in zip(*out, strict=True))
    return (found, confirmed) if whole else found


def carried():
    """Return true poses of a robot that is carried from the room to the hall, and those by odometry."""
    before, after = drive(20), drive(20, (6.0, -3.0, 1.2))
    wheels = np.concatenate((before, drive(20, tuple(before[-1]))))
    return np.concatenate((before, after)), wheels


def test_a_robot_that_drives_is_not_carried():
    assert not shares(drive(100, (-1.5, -1.0, 0.3))).any()


def test_a_robot_that_turns_in_the_door_is_not_carried():
    turning = np.array([[2.9, 0.0, 0.05 * k] for k in range(80)])
    assert not shares(turning).any()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("y", [-0.3, -0.15, 0.0])
def test_a_robot_that_drives_fast_through_a_door_is_not_carried(y, seed):
    """In the door, its lidar sees the wall on both sides from the edge, and the next scan from behind."""
    angles, rng = np.radians(np.arange(-180.0, 180.0)), np.random.default_rng(seed)
    past, geometry = no_past(360), Geometry(np.zeros(3), -math.pi, math.radians(1.0))
    for k, pose in enumerate(np.linspace((1.6, y, 0.0), (4.0, y, 0.0), 17)):
        ranges = cast(WORLD, pose=pose, angles=angles, range_max=3.5).scan.ranges
        ranges = ranges * (1.0 + 0.01 * rng.standard_normal(360))
        estimate = pose + rng.normal(0.0, (0.02, 0.02, 0.01))
        assert find_change(ranges, estimate, 0.2 * k, past, geometry)[0] == 0.0


def test_a_robot_that_weaves_is_not_carried():
    """Sweeps of a turn are distorted: at 2.5 rad/s their ends by 7 deg, against those of the other turn."""
    rates = np.where(np.arange(80) // 4 % 2, -2.5, 2.5)
    poses = drive(80, (1.2, -1.2, 1.4))
    poses[:, 2] += (np.cumsum(rates) - 0.5 * rates) / RATE - 0.5
    assert not shares(poses, rates=rates).any()


def test_a_carried_robot_is_found_in_the_first_scan_and_confirmed_by_the_second():
    poses, wheels = carried()
    found, confirmed = shares(poses, odometry=wheels, whole=True)
    assert np.flatnonzero(found)[0] == 20
    assert found[20] > 0.1
    assert np.flatnonzero(confirmed)[0] == 21


def test_a_scan_that_misses_an_object_once_confirms_nothing():
    """A lidar that pitches looks over the object, and sees it again in the next scan."""
    box, poses = person(1.0, 0.2), np.zeros((50, 3))
    found, confirmed = shares(poses, [box] * 25 + [[]] + [box] * 24, whole=True)
    assert np.flatnonzero(found).tolist() == [25]
    assert not confirmed.any()


def test_results_do_not_depend_on_how_scans_are_cut():
    poses, wheels = carried()
    whole = shares(poses, odometry=wheels)
    for cut in (1, 15, 20, 21, 33):
        np.testing.assert_array_equal(shares(poses, odometry=wheels, cut=cut), whole)


def test_an_object_that_appears_and_stays_is_found_when_it_is_known_to_be_static():
    poses, box = np.zeros((40, 3)), person(1.0, 0.2)
    found = shares(poses, [[]] * 20 + [box] * 20)
    assert np.flatnonzero(found).tolist() == [20 + int(RATE)]


def test_people_who_walk_past_are_left_out():
    walker = [person(0.8, -1.5 + 0.1 * k) for k in range(40)]
    assert not shares(drive(40), walker).any()


@pytest.mark.parametrize("turn", [2.0, 2.45])
def test_a_person_who_turns_back_is_left_out(turn):
    """A second later he is where he was."""
    times = np.arange(40) / RATE
    along = 1.5 * np.abs(times - turn) - 0.75
    poses = np.tile([-1.0, 0.0, 0.0], (40, 1))
    assert not shares(poses, [person(-0.4, y) for y in along]).any()


def test_a_person_who_enters_and_leaves_within_a_second_is_left_out():
    poses = np.zeros((40, 3))
    assert not shares(poses, [[]] * 20 + [person(1.0, 0.2)] * 5 + [[]] * 15).any()


def test_scans_that_are_far_apart_in_time_are_not_compared():
    poses, wheels = carried()
    assert not shares(poses, odometry=wheels, interval=1.01 * MAX_INTERVAL).any()


def doubts(interval):
    """Return the shares in doubt of 40 scans, of which the last 20 see a wall 2 m ahead."""
    past, found = no_past(len(ANGLES)), []
    for k in range(40):
        walls = [*WORLD, [(1.0, -1.0), (1.0, 1.0)]] if k >= 20 else WORLD
        ranges = scan_at((-1.0, 0.0, 0.0), np.array(walls, float))
        find_change(ranges, np.zeros(3), interval * k, past, GEOMETRY)
        found.append(doubted_share(past, GEOMETRY))
    return np.array(found)


def test_a_doubt_ends_when_new_points_are_judged():
    found = doubts(0.1)
    assert not found[:20].any()
    assert (found[20:29] > MIN_DOUBTED).all()
    assert not found[31:].any()


def test_nothing_is_in_doubt_if_time_stands_still():
    """In a log without stamps, a doubt would never end."""
    assert not doubts(0.0).any()


def test_scans_of_two_lidars_are_not_compared_with_each_other():
    check, poses = JumpCheck(), drive(20)
    assert not shares(poses, check=check).any()
    assert not shares(drive(20, (6.0, -3.0, 1.2)), check=check, sensor="b").any()


@pytest.mark.parametrize("beams", [0, 1])
def test_scans_of_hardly_any_beam_show_nothing(beams):
    empty = np.zeros((5, beams))
    scans = Scans(
        np.arange(5.0), np.zeros(beams), empty, empty > 0, np.zeros((5, beams, 2)), empty,
        np.zeros((5, beams, 2)), empty, 0.0, 30.0, GEOMETRY.laser,
    )  # fmt: skip
    motions = Motions(scans.stamps, np.zeros((5, 3)), np.zeros((5, 3, 3)), np.full(5, 0.1))
    assert not JumpCheck().find(motions, beam_columns(scans, 5), "a")[0].any()


def test_the_keyframe_of_a_carried_robot_restarts_the_gate(monkeypatch):
    """The next one is due 11 cm later, not 11 cm after the one before."""
    poses, m = drive(16), 16
    walls, angles = room(-2.0, 3.5, -1.5, 2.2), np.linspace(-2.0, 2.0, 180)
    scans = [cast(walls, pose=pose, angles=angles).scan for pose in poses]
    d_pose = np.vstack((np.zeros(3), between(poses[:-1], poses[1:])))
    increments = [Increment(0.1 * k, d_pose[k], 1e-6 * np.eye(3), 0.1) for k in range(m)]
    monkeypatch.setattr(JumpCheck, "find", lambda *_: (np.zeros(m), np.arange(m) == 6))
    out = steps(OdometryTracker(), increments, scans, limits=(0.11, np.inf, np.inf))
    assert np.flatnonzero(out.is_keyframe).tolist() == [4, 6, 10, 14]


def test_the_fast_test_leaves_out_many_points_and_none_in_free_space(rng):
    left_out = tested = inside = 0
    for _ in range(60):
        first, second = np.array([-1.0, 0.0, 0.3]) + rng.normal(0.0, 0.04, (2, 3))
        scans = np.array([scan_at(first, WORLD), scan_at(second, WORLD)])
        lost = ~np.isfinite(scans) | (rng.random(scans.shape) < 0.05)
        scans[1] += rng.uniform(0.0, 0.5)  # around the clearance
        ranges, other = np.where(lost, 0.0, scans)
        motion = laser_motion(second, first, GEOMETRY)
        free, view = free_ranges(other, GEOMETRY), _view(motion, GEOMETRY)
        for i in np.flatnonzero(ranges).tolist():
            k, reach = seen_from(i, ranges[i], motion, len(ranges), GEOMETRY)
            is_free = k >= 0 and reach < free[k] - CLEARANCE
            angle = GEOMETRY.first + i * GEOMETRY.spacing
            beam = math.cos(angle), math.sin(angle)
            fast = _is_not_free(i, ranges[i], beam, other, view, GEOMETRY)
            assert not (fast and is_free)
            left_out, tested, inside = left_out + fast, tested + 1, inside + is_free
    assert left_out > 0.35 * tested
    assert inside > 0.2 * tested
