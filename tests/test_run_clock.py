"""Clocks that are set while a log is recorded: motion is kept in file order."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.recorded import Played
from tests.steps import Steps

from impslam.cli.simulate import write_log
from impslam.columns import messages as read_messages
from impslam.config import load
from impslam.geometry.se2 import exp
from impslam.run import map_log
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.sources.rosbag import RosBag
from impslam.types import LaserScan, OdometryPose, Steering, TruePose, Velocity, WheelAngles

SPEED, TURN, RADIUS, TRACK = 0.5, 0.2, 0.0635, 0.40
PERIOD = 0.02  # s, of odometry
STEPS = [-3600.0, -30.0, -2.0, 30.0, 3600.0]
STREAMS = [("odometry",), ("scans",), ("odometry", "scans")]
PLAIN = [
    "tracker.kind=odometry",
    *(f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "corners", "cylinders")),
]


def wheels(t):
    left, right = (SPEED + side * 0.5 * TRACK * TURN for side in (-1, 1))
    return WheelAngles(t, left * t / RADIUS, right * t / RADIUS)


KINDS = {
    "encoders": (wheels, ("imp", [])),
    "odometry_pose": (
        lambda t: OdometryPose(t, exp(t * np.array([SPEED, 0.0, TURN]))),
        ("default", []),
    ),
    "velocity": (
        lambda t: Velocity(t, SPEED, TURN),
        ("default", ["odometry.kind=velocity"]),
    ),
    "ackermann": (
        lambda t: Steering(t, SPEED, 0.1),
        ("default", ["odometry.kind=ackermann", "odometry.wheelbase=0.5"]),
    ),
}
"""What the odometry of a robot says at t s, and its config."""
HELD = ("velocity", "ackermann")
"""Whose motion is a speed times the time between stamps: a clock that is set costs one reading."""


class Kept(Steps):
    """Compares paths."""

    @property
    def poses(self):
        return [r.pose for r in self.results]

    @property
    def stamps(self):
        return [r.stamp for r in self.results]

    @property
    def length(self):
        return float(np.hypot(*np.diff(self.poses, axis=0)[:, :2].T).sum())

    def apart(self, other):
        """Return how far apart two paths are at each scan, m."""
        return np.hypot(*(np.array(self.poses) - np.array(other.poses))[:, :2].T)


def stream(message):
    return "scans" if isinstance(message, LaserScan) else "odometry"


def recorded(kind):
    """Return 20 s of even motion: odometry at 50 Hz, scans at 10 Hz that arrive 50 ms late."""
    angles = np.linspace(-1.0, 1.0, 9)
    sent = [(t, KINDS[kind][0](1.0 + t)) for t in np.arange(0.0, 20.0, PERIOD).tolist()]
    sent += [
        (t + 0.05, LaserScan(1.0 + t, angles, np.ones(9), np.zeros(9)))
        for t in np.arange(0.0, 19.9, 0.1).tolist()
    ]
    return [message for _, message in sorted(sent, key=lambda pair: pair[0])]


def set_clock(messages, by, who, at):
    """Return the messages with the clocks of some streams set by so many seconds at a moment."""
    return [
        replace(m, stamp=m.stamp + by) if m.stamp >= at and stream(m) in who else m
        for m in messages
    ]


def play(messages, config, tmp_path):
    kept = Kept()
    map_log(config, Played.of(messages, tmp_path), [kept])
    return kept


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("who", STREAMS)
def test_motion_is_kept_whatever_stamps_do(kind, who, tmp_path):
    preset, settings = KINDS[kind][1]
    config = load(preset, [*PLAIN, *settings])
    messages = recorded(kind)
    plain = play(messages, config, tmp_path)
    lost = SPEED * PERIOD if kind in HELD and "odometry" in who else 0.0
    for by in STEPS:
        kept = play(set_clock(messages, by, who, at=11.0), config, tmp_path)
        assert len(kept.poses) == len(plain.poses)
        # Ahead, it takes the next scan of each stream to know that not all have paused.
        late = SPEED * 0.12 if by > 0.0 else 0.0
        assert kept.apart(plain).max() <= lost + late + 1e-6
        assert kept.apart(plain)[-1] <= lost + (SPEED * 0.01 if by > 0.0 else 0.0) + 1e-6
        if by < 0.0:
            assert kept.stamps == [
                m.stamp for m in set_clock(messages, by, who, at=11.0) if isinstance(m, LaserScan)
            ]
            said = kept.outcome.dropped["clock step"].example
            assert f"stepped back by {-by:g} s" in said
            assert "motion is kept in file order" in said


@pytest.mark.parametrize("kind", KINDS)
def test_a_clock_that_stands_for_a_second_costs_no_motion(kind, tmp_path):
    preset, settings = KINDS[kind][1]
    config = load(preset, [*PLAIN, *settings])
    messages = recorded(kind)
    plain = play(messages, config, tmp_path)
    stuck = [replace(m, stamp=10.5) if 10.5 < m.stamp < 11.5 else m for m in messages]
    kept = play(stuck, config, tmp_path)
    assert kept.apart(plain)[-1] < 1e-6


@pytest.mark.parametrize("by", [-3600.0, -30.0, 3600.0])
def test_a_simulated_log_with_stepping_stamps_gives_the_same_path(by, tmp_path):
    """Through a file, as users have it: every stream steps, the truth as well."""
    log, stepped = tmp_path / "plain.mcap", tmp_path / "stepped.mcap"
    write_log(load_world("room"), log, seed=0)
    with RosBag(path=log) as source:
        messages = list(read_messages(source.batches()))
    middle = messages[len(messages) // 2].stamp
    with McapWriter(stepped) as writer:
        for message in messages:
            moved = 4000.0 + message.stamp + by * (message.stamp >= middle)
            writer.write(replace(message, stamp=moved))
    paths = []
    for path in (log, stepped):
        kept = Kept()
        map_log(load("imp"), RosBag(path=path), [kept])
        paths.append(kept)
    plain, kept = paths
    assert kept.length == pytest.approx(plain.length, abs=0.005)
    assert kept.apart(plain).max() < 0.01
    truth = next(m for m in reversed(messages) if isinstance(m, TruePose))
    assert math.dist(kept.poses[-1][:2], truth.pose[:2]) < 0.03
