"""Detection of wrong odometry lengths, with their size, while the robot drives."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from impslam.component import build
from impslam.diagnosis.finding import ERROR_RATE
from impslam.diagnosis.odometry_watch import OdometryWatch, _needed_sigmas
from impslam.geometry.se2 import compose
from impslam.map import Keyframe, Revision
from impslam.odometry.kernels import wheel_motions
from impslam.types import Increment

RADIUS, TRACK = 0.05, 0.30
WHEELS = {"kind": "encoders", "wheel_radius": RADIUS, "track": TRACK}
STEP = 0.5  # s between keyframes
ERROR = np.array([0.01, 0.01, 0.008])  # m, m, rad: error of an estimate in a map
ADVICE = ": run `imp calibrate` on a log of this robot"


def watch(odometry, gyro_turns=False):
    return OdometryWatch(
        SimpleNamespace(odometry=build("odometry", odometry), gyro_turns=gyro_turns)
    )


def drive(seed, true=(RADIUS, RADIUS, TRACK), minutes=5.0, measure=None, slip=0.0):
    """Return poses (n, 3) of a drive, by the estimate and by odometry.

    `true` are the radii of the left and the right wheel, and the track; `measure` maps the true motions
    (n, 3) to those of odometry, in place of wheels.
    """
    rng = np.random.default_rng(seed)
    n = int(60.0 * minutes / STEP)
    speeds = np.repeat(rng.uniform(-0.2, 0.6, (n // 10 + 1, 2)), 10, axis=0)[:n] * STEP
    left, right = speeds.T * (1.0 + 0.01 * rng.standard_normal((2, n)))
    moved, _ = wheel_motions(left, right, true[2], 0.0)
    spun = np.where(rng.random((2, n)) < slip, 0.3, 0.0)
    turns = left / true[0] * RADIUS + spun[0], right / true[1] * RADIUS + spun[1]
    measured = wheel_motions(*turns, TRACK, 0.0)[0] if measure is None else measure(moved)
    measured = measured * (1.0 + 0.02 * rng.standard_normal((n, 1)))
    return chained(moved) + ERROR * rng.standard_normal((n, 3)), chained(measured)


def chained(steps):
    poses = [np.zeros(3)]
    for step in steps[:-1]:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def follow(watched, estimated, measured, located=True):
    """Pass the poses to a watch; return its notice."""
    still = np.zeros(3), np.zeros((3, 3))
    for k, (pose, odometry) in enumerate(zip(estimated, measured, strict=True)):
        motion = Increment(STEP * k, np.zeros(3), np.zeros((3, 3)), STEP)
        frame = Keyframe(k, STEP * k, motion, odometry, *still, None, 0, located=located)
        watched.revise(frame, Revision(np.array([k]), pose[None], np.zeros((1, 3, 3))), None)
    return watched.notice


@pytest.mark.parametrize(
    ("true", "words", "percent"),
    [
        ((0.97 * RADIUS, 0.97 * RADIUS, TRACK), "the wheels' radius is .* smaller", 3.0),
        ((1.05 * RADIUS, 1.05 * RADIUS, TRACK), "the wheels' radius is .* larger", 5.0),
        ((RADIUS, RADIUS, 1.1 * TRACK), "the track is .* wider", 10.0),
        ((RADIUS, RADIUS, 0.94 * TRACK), "the track is .* narrower", 6.0),
        ((1.012 * RADIUS, 0.988 * RADIUS, TRACK), "the right wheel is .* smaller", 2.4),
        (
            (0.96 * RADIUS, 0.96 * RADIUS, 0.96 * TRACK),
            "the wheels' radius and the track are .* smaller than configured, or the lidar's",
            4.0,
        ),
    ],
)
def test_wrong_length_is_reported_with_its_size(true, words, percent):
    notice = follow(watch(WHEELS), *drive(1, true))
    assert re.match(words, notice)
    assert notice.endswith(ADVICE)
    assert ";" not in notice
    size, sigma = map(float, re.search(r"([\d.]+) ± ([\d.]+) %", notice).groups())
    assert abs(size - percent) < 4.0 * sigma
    assert sigma < 0.2 * percent


@pytest.mark.parametrize("slip", [0.0, 0.02])
def test_sound_wheels_give_no_notice(slip):
    """One in fifty motions may be a wheel that spins: 0.3 m in half a second."""
    for seed in range(30):
        assert follow(watch(WHEELS), *drive(seed, minutes=3.0, slip=slip)) == ""


def test_wheels_that_read_the_same_all_the_time_give_no_notice():
    """On a straight drive, odometry's turns, and so their scale, are exactly 0."""
    steps = np.tile([0.4, 0.0, 0.0], (150, 1))
    estimated = chained(steps) + ERROR * np.random.default_rng(3).standard_normal((150, 3))
    assert follow(watch(WHEELS), estimated, chained(steps)) == ""


def test_dead_reckoning_gives_no_notice():
    """Dead reckoning in place of an estimate agrees with odometry, whatever the wheels are."""
    _, measured = drive(2, (0.9 * RADIUS, 0.9 * RADIUS, TRACK))
    assert follow(watch(WHEELS), measured, measured) == ""
    assert (
        follow(watch(WHEELS), *drive(2, (0.9 * RADIUS, 0.9 * RADIUS, TRACK)), located=False) == ""
    )


def test_wear_is_reported_with_its_current_size():
    watched, seen = watch(WHEELS), []
    estimated, measured = (np.array([[0.0, 0.0, 0.0]]) for _ in range(2))
    for share in (1.0, 0.96):
        more = drive(3, (share * RADIUS, share * RADIUS, TRACK), minutes=15.0)
        estimated, measured = (
            np.array([compose(old[-1], p) for p in new])
            for old, new in zip((estimated, measured), more, strict=True)
        )
        seen.append(follow(watched, estimated, measured))
    assert seen[0] == ""
    size, sigma = map(
        float, re.search(r"radius is ([\d.]+) ± ([\d.]+) % smaller", seen[1]).groups()
    )
    assert abs(size - 4.0) < 4.0 * sigma
    assert watched.problems.examples == {"odometry off": seen[1]}


def test_track_is_not_checked_if_a_gyro_measures_turns():
    turned_well = drive(4, measure=lambda moved: moved * (1.06, 1.06, 1.0))
    notice = follow(watch(WHEELS, gyro_turns=True), *turned_well)
    assert re.match(r"the wheels' radius is [56]\.\d ± .* % smaller", notice)
    assert "track" not in notice


def test_odometry_without_wheels_has_scales():
    def measure(moved):
        return moved * (0.95, 0.95, 1.08)

    notice = follow(watch({"kind": "odometry_pose"}), *drive(5, measure=measure))
    assert re.match(
        r"odometry's distances are [45]\.\d ± .* % shorter than those of the map; ", notice
    )
    assert re.search(r"; odometry's turns are [78]\.\d ± .* % larger", notice)
    assert notice.endswith(ADVICE)
    car = {"kind": "ackermann", "wheelbase": 2.8}
    assert follow(watch(car), *drive(5, measure=measure)).endswith(
        ": check the lengths and angles in the odometry settings"
    )
    sound = drive(6, measure=lambda moved: moved)
    assert follow(watch({"kind": "odometry_pose"}), *sound) == ""


def test_false_reports_of_all_comparisons_are_as_rare_as_of_one_test():
    rates = [math.erfc(_needed_sigmas(n) / math.sqrt(2.0)) for n in range(1, 2000)]
    assert sum(rates) == pytest.approx(ERROR_RATE, rel=1e-3)
    assert rates == sorted(rates, reverse=True)
