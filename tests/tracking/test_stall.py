"""A robot that is stationary while its wheels turn, and one that drives along uniform walls."""

import numpy as np
import pytest

from impslam.columns import Motions, Scans
from impslam.health import STALLED
from impslam.tracking.beams import beam_columns
from impslam.tracking.stall import initial_stall_state, undo_stalled_motion

ANGLES = np.linspace(-2.0, 2.0, 341)
LASER = np.array([0.1, 0.0, 0.0])


def box(x, y, half_length, half_width, rng):
    """Return ranges in the middle of a box, from a laser at (x, y) facing along x."""
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    ahead = (np.where(c > 0, half_length - x, -half_length - x)) / np.where(c == 0, 1e-9, c)
    aside = (np.where(s > 0, half_width - y, -half_width - y)) / np.where(s == 0, 1e-9, s)
    return np.minimum(ahead, aside) + 0.005 * rng.standard_normal(len(ANGLES))


def driven(steps, odometry, half_length, half_width=1.0, range_max=8.0):
    """Return the motions used and the reasons for true `steps` (m,) and those by `odometry`."""
    rng = np.random.default_rng(3)
    ranges = np.array([box(x, 0.1, half_length, half_width, rng) for x in np.cumsum(steps)])
    return checked(ranges, np.column_stack((odometry, np.zeros((len(steps), 2)))), range_max)


def checked(ranges, d_pose, range_max=8.0):
    """Return the motions used and the reasons for ranges (m, n) and motions by odometry (m, 3)."""
    m = len(ranges)
    directions = np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
    points = LASER[:2] + ranges[:, :, None] * directions
    scans = Scans(
        np.arange(m) / 10.0, ANGLES, ranges, ranges < range_max, points, directions, points, ranges,
        0.0, range_max, LASER,
    )  # fmt: skip
    d_pose[0] = 0.0
    used = Motions(scans.stamps, d_pose.copy(), np.zeros((m, 3, 3)), np.full(m, 0.1))
    reasons = np.zeros(m, np.int8)
    undo_stalled_motion(
        d_pose, used, beam_columns(scans, m), initial_stall_state(len(ANGLES)), reasons
    )
    return used, reasons


@pytest.mark.parametrize("step", [0.02, 0.05, 0.3])
def test_wheels_that_turn_against_a_wall_add_no_motion(step):
    used, reasons = driven(np.zeros(40), np.full(40, step), 3.0)
    assert abs(used.d_pose[:, 0].sum()) < 0.2
    first = int(np.argmax(reasons == STALLED))
    assert step * first <= 0.6
    assert (reasons[first:] == STALLED).all()
    assert (
        used.covariance[first, 0, 0] >= (step * (first - 1)) ** 2
    )  # it may have moved this far before


def test_a_moving_robot_is_left_alone():
    used, reasons = driven(np.full(40, 0.05), np.full(40, 0.05), 3.0)
    assert not reasons.any()
    assert (used.d_pose[1:, 0] == 0.05).all()


@pytest.mark.parametrize("steps", [np.full(40, 0.05), np.zeros(40)])
def test_along_a_bare_corridor_nothing_is_concluded(steps):
    _, reasons = driven(steps, np.full(40, 0.05), 50.0)
    assert not reasons.any()


def test_a_robot_that_comes_off_the_wall_drives_on():
    still, away = np.zeros(20), np.full(20, -0.05)
    odometry = np.concatenate((np.full(20, 0.05), away))
    used, reasons = driven(np.concatenate((still, away)), odometry, 3.0)
    assert reasons[10:20].all()
    assert not reasons[25:].any()
    assert used.d_pose[20:, 0].sum() == pytest.approx(-1.0, abs=0.1)


def test_wheels_that_slip_once_are_not_stalled():
    """As with pillars along a corridor: the ranges are those of 0.25 m before, but not of 0.5 m before."""
    steps = np.full(12, 0.25)
    steps[[3, 7]] = 0.0
    _, reasons = driven(steps, np.full(12, 0.25), 4.0)
    assert not reasons.any()


def test_on_an_arc_along_a_round_wall_nothing_is_concluded():
    """No range changes, but a turn by odometry would change none of them either."""
    rng, m, radius, off = np.random.default_rng(3), 60, 3.0, 0.5
    bearing = ANGLES - np.angle(1j * off - LASER[0])
    distance = abs(1j * off - LASER[0])
    across = np.sqrt(radius**2 - (distance * np.sin(bearing)) ** 2)
    ranges = distance * np.cos(bearing) + across + 0.005 * rng.standard_normal((m, len(ANGLES)))
    step = np.array([0.05, 0.0, 0.05 / off])
    _, reasons = checked(ranges, np.tile(step, (m, 1)))
    assert not reasons.any()


def test_a_robot_that_drives_along_a_wall_it_should_approach_is_left_alone():
    """Noisy odometry reports motion to the side; the ranges to the walls beside the robot do not change."""
    rng, m = np.random.default_rng(3), 20
    ranges = np.array([box(0.1 * k, 0.1, 3.0, 1.0, rng) for k in range(m)])
    _, reasons = checked(ranges, np.tile([0.0, 0.1, 0.0], (m, 1)))
    assert not reasons.any()


@pytest.mark.parametrize("step", [0.05, 0.08, 0.1])
@pytest.mark.parametrize("begin", np.arange(0.2, 1.2, 0.05))
def test_a_robot_that_backs_through_a_door_in_a_corridor_is_left_alone(begin, step):
    """The door's frame is seen beside walls that look the same: after 20 cm more, it is 40 cm further."""
    rng, x = np.random.default_rng(3), begin - step * np.arange(30)
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    frame = -x[:, None] / np.where(c == 0.0, 1e-9, c)
    aside = frame * s
    is_frame = (frame > 0.0) & (np.abs(aside - 0.1) > 0.5)
    walls = box(0.0, 0.1, 50.0, 0.9, rng)
    ranges = np.minimum(walls, np.where(is_frame, frame, np.inf))
    ranges = ranges + 0.005 * rng.standard_normal(ranges.shape)
    _, reasons = checked(ranges, np.tile([-step, 0.0, 0.0], (30, 1)), 5.6)
    assert not reasons.any()
