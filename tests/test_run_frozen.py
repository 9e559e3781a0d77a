"""Encoders that freeze while the robot drives: the pose follows the scans, and the run says so."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.recorded import Played

from impslam.cli.ending import EndOfRun
from impslam.cli.job import execute
from impslam.config import load
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import TruePose, WheelAngles


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


def mapped(messages, folder):
    folder.mkdir()
    world, end = load_world("arena"), EndOfRun()
    config = load("imp", [f"start={list(map(float, world.robot.start))}"])
    run = folder / "run"
    execute(config, Played.of(messages, folder), run, True, [end])
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
    said = {span["reason"].split(";")[0] for span in told["spans"]}
    known = {
        "the scans show another motion than odometry",
        "the robot moves, the wheels do not",
    }
    assert said <= known
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
