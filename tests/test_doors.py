"""A door that opens in front of the robot: it drives on into the room behind, in one map."""

import math

import numpy as np
import pytest
from tests.extractors.scans import cast, regular_angles, room

import impslam
from impslam.health import LOST
from impslam.types import Array

ANGLES = regular_angles(361, math.pi)
HALF = 0.5  # m: half of the door's width
AT = 6.0  # m: x of the door, at the end of the corridor
WAIT, SWING = 3.0, 1.2  # s


def line(*points: tuple[float, float]) -> Array:
    """Return the walls (n, 2, 2) along a line."""
    return np.stack((points[:-1], points[1:]), axis=1).astype(float)


BUILDING = np.concatenate((
    line((6, -HALF), (6, -1), (-6, -1), (-6, 1), (-3, 1), (-3, 1.4), (-2.2, 1.4), (-2.2, 1)),
    line((-2.2, 1), (2, 1), (2, 1.4), (2.8, 1.4), (2.8, 1), (6, 1), (6, HALF)),
    line((6, -1), (6, -4), (14, -4), (14, 5), (6, 5), (6, 1)),
    room(9, 10, 1.5, 2.5)[:, ::-1], room(11, 12, -3, -2)[:, ::-1],
))  # fmt: skip
"""A corridor with two niches, and the room behind its door."""


def leaf(opened: float) -> Array:
    """Return the leaf of the door (1, 2, 2), opened by a share of a right angle."""
    angle = 0.5 * math.pi * opened
    end = AT + 2.0 * HALF * math.sin(angle), -HALF + 2.0 * HALF * math.cos(angle)
    return line((AT, -HALF), end)


def positions(stop: float, rate: float) -> tuple[Array, Array]:
    """Return x (n,) m of a robot that waits before the door, and the share (n,) by which it is open."""
    step = 0.5 / rate
    before, after = np.arange(-5.0, AT - stop, step), np.arange(AT - stop, 11.0, step)
    waiting = round((WAIT + SWING) * rate)
    x = np.concatenate((before, np.full(waiting, before[-1]), after))
    seconds = (np.arange(len(x)) - len(before)) / rate - WAIT
    return x, np.clip(seconds / SWING, 0.0, 1.0)


@pytest.mark.parametrize("rate", [5.0, 10.0])
@pytest.mark.parametrize("stop", [0.4, 0.7, 1.5])
def test_a_door_that_swings_open_is_no_new_place(stop, rate) -> None:
    x, opened = positions(stop, rate)
    rng, poses = np.random.default_rng(1), np.column_stack((x, np.zeros((len(x), 2))))
    ranges = np.array([
        cast(np.concatenate((BUILDING, leaf(share))), pose=pose, angles=ANGLES, range_max=30.0).scan.ranges
        for pose, share in zip(poses, opened, strict=True)
    ])  # fmt: skip
    ranges += rng.normal(0.0, 0.01, ranges.shape)
    slam, stamps = impslam.Slam("default"), np.arange(len(x)) / rate
    slam.add_odometry(stamps, poses * (1.02, 1.0, 1.0))
    slam.add_scans(stamps, ranges, ANGLES, range_max=30.0)
    known = slam.finish()
    assert not (slam._run._health.health.states == LOST).any()
    assert known.keyframes.placed.all()
    off = known.path()[:, 1:3] - (poses[:, :2] - poses[0, :2])
    assert np.hypot(*off.T).max() < 0.1
