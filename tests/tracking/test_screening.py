"""Odometry that falls silent while scans go on: the robot may have gone on."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

from impslam.health import NONE, SKIPPED
from impslam.sources.base import Problems
from impslam.tracking.screening import MAX_SILENCE, Screening
from impslam.types import Increment

PERIOD, SPEED, SILENT = 0.1, 0.4, 20
SCAN = cast(room(-3.0, 6.0, -2.0, 2.5), angles=np.linspace(-1.0, 1.0, 20)).scan


def screened(speeds, cut=None):
    """Return the parts of sweeps with odometry at these speeds (m,), m/s; NaN: without odometry."""
    stamps = PERIOD * np.arange(len(speeds))
    increments = [
        Increment(t, np.array([np.nan_to_num(v) * PERIOD, 0.0, 0.0]), np.zeros((3, 3)), s)
        for t, v, s in zip(stamps, speeds, np.where(np.isnan(speeds), 0.0, PERIOD), strict=True)
    ]
    screening, parts = Screening(), (slice(0, cut), slice(cut, None)) if cut else (slice(None),)
    motions, sweeps = motions_of(increments), sweeps_of([SCAN] * len(stamps), stamps)
    problems = Problems()
    return [screening.screen(motions.take(p), sweeps.take(p), problems) for p in parts], problems


def reasons(speeds, cut=None):
    """Return the reasons of the sweeps."""
    return np.concatenate([one.reasons for one in screened(speeds, cut)[0]])


@pytest.mark.parametrize("cut", [None, 22, 35])
def test_odometry_that_falls_silent_while_the_robot_moves_is_reported_until_it_returns(cut):
    speeds = np.full(60, SPEED)
    speeds[SILENT:45] = np.nan
    found, late = reasons(speeds, cut), round(MAX_SILENCE / PERIOD) + 1
    assert (found[SILENT + late : 45] == SKIPPED).all()
    assert not (found[: SILENT + late - 2] == SKIPPED).any()
    assert not (found[45:] == SKIPPED).any()


@pytest.mark.parametrize("speed", [0.0, 0.02])
def test_a_robot_that_stood_may_be_silent(speed):
    """At 2 cm/s it goes less than 20 cm in the time."""
    speeds = np.full(60, speed)
    speeds[SILENT:] = np.nan
    assert (reasons(speeds) == NONE).all()


def test_slow_odometry_is_not_silent():
    """Every tenth sweep gets the motion of a second."""
    speeds = np.full(60, np.nan)
    speeds[::10] = 10.0 * SPEED
    assert not (reasons(speeds) == SKIPPED).any()


@pytest.mark.parametrize("cut", [None, 22, 35, 45])
@pytest.mark.parametrize(
    ("begin", "end", "span"),
    [
        (0, 30, "from 0.000 to 3.000 s"),
        (20, 45, "from 1.900 to 4.500 s"),
        (40, 60, "after 3.900 s"),
    ],
)
def test_missing_odometry_is_reported_once_with_its_begin_and_end(begin, end, span, cut):
    speeds = np.full(60, SPEED)
    speeds[begin:end] = np.nan
    parts, problems = screened(speeds, cut)
    assert problems.counts["odometry missing"] == 1
    assert f"no odometry for the scans {span}: " in problems.examples["odometry missing"]
    unmeasured = np.concatenate([part.unmeasured for part in parts])
    assert unmeasured[begin + 4 : end + 30].all()  # differences for 3 s after it are due to it
    assert not unmeasured[:begin].any()
    assert not unmeasured[end + 31 :].any()


@pytest.mark.parametrize("silent_at_the_end", [False, True])
def test_a_lidar_whose_sweeps_end_with_those_of_another_one_has_odometry(silent_at_the_end):
    """All motion belongs to the sweeps of the first lidar: none is left for those of the second one."""
    screening, problems, pose = Screening(), Problems(), np.array([SPEED * PERIOD, 0.0, 0.0])
    for k in range(60):
        stamp, seconds = k * PERIOD, 0.0 if silent_at_the_end and k > 40 else PERIOD
        front = Increment(stamp, pose * (seconds > 0.0), np.zeros((3, 3)), seconds)
        rear = Increment(stamp, np.zeros(3), np.zeros((3, 3)), 0.0)
        for sensor, motion in (("front", front), ("rear", rear)):
            sweeps = replace(sweeps_of([SCAN], [stamp]), sensor=sensor)
            part = screening.screen(motions_of([motion]), sweeps, problems)
    assert part.unmeasured.all() == silent_at_the_end
    assert problems.counts.get("odometry missing", 0) == silent_at_the_end
