"""Beams that end on the robot's own body, a cable or a cover are left out; walls and people are not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import scans_of

from impslam.geometry.se2 import compose, exp
from impslam.tracking.covered import hidden_beams, initial_cover

ROOM = room(-3.0, 6.0, -2.0, 2.5)
ANGLES = np.linspace(-2.0, 2.0, 240)
STEP = exp(np.array([0.04, 0.0, 0.03]))
SECTOR, FEW = slice(80, 160), slice(80, 104)


def driven(step=STEP, scans=60, lines=ROOM):
    pose, out = np.zeros(3), []
    for _ in range(scans):
        out.append(cast(lines, pose=pose, angles=ANGLES, sigma=0.005).scan)
        pose = compose(pose, step)
    return scans_of(out)


def covered(scans, distance=0.3, begin=20, sector=SECTOR):
    ranges, points = scans.ranges.copy(), scans.points.copy()
    noise = np.random.default_rng(1).standard_normal(ranges[begin:, sector].shape)
    ranges[begin:, sector] = distance + 0.01 * noise
    along = np.stack((np.cos(scans.angles), np.sin(scans.angles)), axis=-1)[sector]
    points[begin:, sector] = ranges[begin:, sector, None] * along
    return ranges, points


def hidden(scans, columns, cut=1000, steps=STEP):
    cover, out = initial_cover(len(ANGLES)), []
    ranges, points = columns
    scans = replace(scans, ranges=ranges, points=points)
    for k in range(0, len(ranges), cut):
        part = slice(k, k + cut)
        d_pose = np.broadcast_to(steps, (len(ranges), 3))[part]
        out.append(hidden_beams(np.ascontiguousarray(d_pose), scans.take(part), cover))
    return np.concatenate(out)


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_a_small_cover_is_left_out_after_less_than_a_metre_and_nothing_else(cut):
    scans = driven()
    out = hidden(scans, covered(scans, sector=FEW), cut)
    assert not out[:25].any()
    assert out[45:, FEW].mean() > 0.9
    rest = np.delete(out, np.arange(len(ANGLES))[FEW], axis=1)
    assert rest.mean() < 0.01


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_a_large_cover_is_left_out_at_once_for_as_long_as_it_stays(cut):
    scans = driven()
    out = hidden(scans, covered(scans), cut)
    assert not out[:20].any()
    assert out[20:, SECTOR].mean() > 0.95
    rest = np.delete(out, np.arange(len(ANGLES))[SECTOR], axis=1)
    assert rest.mean() < 0.01


def test_a_robot_carried_to_a_wall_has_no_cover():
    scans = driven()
    elsewhere = cast(ROOM, pose=np.array([5.5, 0.0, 0.0]), angles=ANGLES, sigma=0.005).scan
    scans.ranges[20:], scans.points[20:] = elsewhere.ranges, scans_of([elsewhere]).points
    assert (scans.ranges[20] < 1.0).mean() > 0.3
    assert not hidden(scans, (scans.ranges, scans.points))[20].any()


def test_a_wall_that_comes_into_view_in_a_turn_is_no_cover():
    turn = exp(np.array([0.0, 0.0, 0.14]))
    lines = np.concatenate((ROOM, [[[0.0, 0.6], [3.0, 0.6]]]))
    scans = driven(turn, lines=lines)
    steps, cover = np.tile(turn, (60, 1)), initial_cover(len(ANGLES))
    assert (scans.ranges.min(axis=1) < 1.0).any()
    assert not hidden_beams(steps, scans, cover).any()


def test_a_cover_that_is_taken_away_is_forgotten():
    scans = driven()
    ranges, points = covered(scans)
    ranges[50:], points[50:] = scans.ranges[50:], scans.points[50:]
    out = hidden(scans, (ranges, points))
    assert out[49, SECTOR].any()
    assert not out[57:].any()


def test_a_clean_drive_hides_nothing():
    scans = driven(scans=150)
    assert not hidden(scans, (scans.ranges, scans.points)).any()


def test_a_wall_close_by_that_is_followed_is_no_cover():
    lines = np.array([[[-5.0, 0.4], [20.0, 0.4]], [[20.0, -1.5], [-5.0, -1.5]]])
    scans = driven(np.array([0.04, 0.0, 0.0]), lines=lines)
    assert not hidden(scans, (scans.ranges, scans.points)).any()


def test_wrong_odometry_makes_no_cover_of_a_wall_close_by(rng):
    """Along a wall nearly all ranges stay, whatever odometry says; the others show that it is wrong."""
    steps = STEP + 0.15 * rng.standard_normal((60, 3))
    lines = room(-3.0, 6.0, -0.6, 2.5)
    scans = driven(np.array([0.04, 0.0, 0.0]), lines=lines)
    assert not hidden(scans, (scans.ranges, scans.points), steps=steps).any()


def test_a_stalled_robot_has_no_cover():
    scans = driven(np.zeros(3))
    assert not hidden(scans, (scans.ranges, scans.points)).any()


@pytest.mark.parametrize("beams", [1, 4])
def test_beams_in_one_direction_hide_nothing(beams):
    """A sonar has one beam; a driver that knows no angles gives all beams the same one."""
    scans = scans_of([cast(ROOM, pose=np.zeros(3), angles=np.zeros(beams)).scan] * 12)
    assert not hidden_beams(np.tile(STEP, (12, 1)), scans, initial_cover(beams)).any()
