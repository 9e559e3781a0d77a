"""Encoders that freeze, and wheels that turn against a wall: the pose follows the scans, and says so."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.recorded import Played

from impslam.cli.job import execute
from impslam.config import load
from impslam.observers.ending import EndOfRun
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan, TruePose, WheelAngles

UNFIT = "most observations match no earlier landmark"
"""What is said where landmarks were entered from a pose that odometry had led astray."""
CHANGED = "of the scan has changed at once"
"""What is also said of scans that odometry, which stands still or runs ahead, does not explain."""
ONE_SIDED, FAR = (
    "landmarks keep correcting odometry in one direction",
    "as far from their positions as expected",
)
"""What is also said until wheels that turn in vain are found out."""


def reasons(health, *consequences):
    """Return the reasons for which the pose was not trusted, without these consequences of them."""
    said = {span["reason"].split(";")[0] for span in health["spans"]}
    return {one for one in said if not any(text in one for text in consequences)}


def frozen(messages, at, seconds, wheels):
    """Return the messages with the counts lost that some wheels (left, right) would have told."""
    lost, last = np.zeros(2), None
    for m in messages:
        if isinstance(m, WheelAngles):
            angles = np.array([m.left, m.right])
            if last is not None and at <= m.stamp < at + seconds:
                lost += (angles - last) * wheels
            last = angles
            left, right = angles - lost
            yield replace(m, left=float(left), right=float(right))
        else:
            yield m


def against_a_wall(messages, at, seconds, speed):
    """Return the messages with a stay in between, in which the wheels turn at a speed in rad/s."""
    before = [m for m in messages if m.stamp < at]
    stay, rng = [], np.random.default_rng(2)
    newest = {type(m): m for m in before}
    for kind, rate in ((WheelAngles, 50.0), (LaserScan, 10.0), (TruePose, 10.0)):
        for k in range(int(rate * seconds)):
            m, t = newest[kind], (k + 1) / rate
            if kind is WheelAngles:
                m = replace(m, left=m.left + speed * t, right=m.right + speed * t)
            elif kind is LaserScan:
                noise = 0.003 * rng.standard_normal(len(m.ranges))
                m = replace(m, ranges=m.ranges + noise)
            stay.append(replace(m, stamp=m.stamp + t))
    turned = speed * seconds
    after = [
        replace(m, stamp=m.stamp + seconds, left=m.left + turned, right=m.right + turned)
        if isinstance(m, WheelAngles)
        else replace(m, stamp=m.stamp + seconds)
        for m in messages
        if m.stamp >= at
    ]
    return [*before, *sorted(stay, key=lambda m: m.stamp), *after]


def mapped(messages, folder):
    folder.mkdir()
    world, end = load_world("arena"), EndOfRun()
    start = f"start={list(map(float, world.robot.start))}"
    config = load("imp", [start, "odometry.gyro.use=false"])  # the gyro would tell half of it
    run = folder / "run"
    execute(config, Played.of(messages, folder), run, True, more=[end])
    true = next(m for m in reversed(messages) if isinstance(m, TruePose))
    error = math.dist(end.pose[:2], true.pose[:2])
    return error, end.outcome, json.loads((run / "summary.json").read_text()), run


@pytest.fixture(scope="module")
def arena():
    return list(simulate(load_world("arena"), seed=1))


@pytest.mark.parametrize("wheels", [(1, 1), (1, 0)], ids=["both", "left"])
def test_a_frozen_encoder_is_no_silent_divergence(arena, wheels, tmp_path):
    """Before scans were asked, the end was 1 m and 2.3 m off at a sigma of 2 and 8 cm, without a word."""
    begin, end = arena[0].stamp, arena[-1].stamp
    messages = list(frozen(arena, begin + 0.4 * (end - begin), 5.0, np.array(wheels)))
    error, outcome, summary, run = mapped(messages, tmp_path / "log")
    assert error < 0.05
    told = summary["health"]
    assert told["scans"]["DEGRADED"] > 20
    assert (told["scans"]["LOST"], told["at_end"]) == (0, "TRACKING")
    said = reasons(told, UNFIT, CHANGED)
    assert said <= {
        "the scans show another motion than odometry",
        "the robot moves, the wheels do not",
    }
    assert said
    assert "odometry against scans" in summary["dropped"]
    assert outcome.health.summary in (run / "report.html").read_text()


def test_an_unperturbed_run_is_trusted_throughout(arena, tmp_path):
    error, outcome, summary, run = mapped(arena, tmp_path / "log")
    assert error < 0.01
    assert summary["health"]["spans"] == []
    assert summary["health"]["at_end"] == "TRACKING"
    assert set(np.loadtxt(run / "trajectory.csv", delimiter=",", skiprows=1)[:, 10]) == {0.0}
    assert outcome.dropped == {}
    assert "Pose: TRACKING throughout." in (run / "report.html").read_text()


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_wheels_that_turn_against_a_wall_do_not_move_the_robot(arena, speed, tmp_path):
    """Before ranges were compared, the robot went on through the wall for as far as its wheels told."""
    begin, end = arena[0].stamp, arena[-1].stamp
    messages = against_a_wall(arena, begin + 0.4 * (end - begin), max(8.0, 16.0 / speed), speed)
    error, _, summary, _ = mapped(messages, tmp_path / "log")
    assert error < 0.05
    told = summary["health"]
    assert told["scans"]["DEGRADED"] > 20
    assert reasons(told, UNFIT, CHANGED, ONE_SIDED, FAR) == {"the wheels turn, the robot does not"}
    assert told["at_end"] == "TRACKING"
