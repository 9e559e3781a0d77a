"""Scans that tell little, nothing, or lies: the pose is dead-reckoned, its covariance and health say so."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from impslam.config import load
from impslam.geometry.se2 import between
from impslam.health import STATES, state_of
from impslam.run import Run
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World
from impslam.types import LaserScan, TruePose

WITHIN = 11.345  # chi^2 of 3 degrees of freedom, 99 %
BOX = [(0.0, 0.0), (11.0, 0.0), (11.0, 6.0), (0.0, 6.0), (0.0, 0.0)]
CORE = [(3.0, 2.4), (3.0, 3.6), (7.5, 3.6), (7.5, 2.4), (3.0, 2.4)]
LAP = [(3.0, 1.2), (9.0, 1.2), (9.0, 4.8), (1.5, 4.8), (1.5, 1.2), (4.0, 1.2)]
BOXES = [((5.0, 0.3), (0.8, 0.6)), ((10.6, 3.0), (0.8, 0.5)), ((0.4, 3.5), (0.5, 0.9))]
SETTINGS = ["tracker.kind=scan_to_map", "estimator.kind=graph"]
SETTINGS += [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "cylinders")]


def hall(core=CORE, people=()):
    """Return a hall with a lap of 25 m around its core."""
    drive = {"start": (1.5, 1.2, 0.0), "speed": 0.6, "turn_rate": 0.9, "waypoints": LAP}
    walls = [{"start": a, "end": b} for line in (BOX, core) for a, b in pairwise(line)]
    boxes = [{"centre": centre, "size": size} for centre, size in BOXES]
    return World(robot=drive, walls=walls, boxes=boxes, people=people)


def recorded(world, **lidar):
    """Return what the robot records in a world."""
    return list(simulate(world, SimulatedRobot(imu=None, lidar=Lidar(**lidar))))


def spoilt(messages, spoil):
    """Return the messages with the ranges of each scan changed; `spoil` takes the scan."""
    return [replace(m, ranges=spoil(m)) if isinstance(m, LaserScan) else m for m in messages]


class Outcome:
    """A run's end: errors (n, 3) against the truth, covariances, odometry's errors, and its health."""

    def __init__(self, messages):
        run = Run(load("imp", SETTINGS))
        run.play(m for m in messages if not isinstance(m, TruePose))
        known = run.refined()
        rows = known.rows()
        health = run.outcome(Path("log"), "", 0).health
        true = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
        driven = np.array([true[stamp] for stamp in known.stamps])
        self.live = between(between(driven[0], driven), known.live_poses)
        truth = np.array([true[stamp] for stamp in rows.stamps])
        truth = between(truth[0], truth)
        self.errors = between(truth, rows.poses)
        self.covariances = rows.covariances
        self.odometry = between(truth, rows.odometry)
        offset = rows.poses - truth
        offset[:, 2] = np.remainder(offset[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        P = rows.covariances + 1e-12 * np.eye(3)
        self.nees = np.einsum("ni,ni->n", offset, np.linalg.solve(P, offset[..., None])[..., 0])
        self.states = [STATES[state_of(reason)] for reason in health.reasons]
        self.words = health.summary

    @property
    def metres(self):
        return np.hypot(self.errors[:, 0], self.errors[:, 1])

    @property
    def sigma(self):
        """(n,) m, of the position."""
        return np.sqrt(self.covariances[:, 0, 0] + self.covariances[:, 1, 1])


@pytest.fixture(scope="module")
def plain():
    return recorded(hall())


def dead_reckoned(outcome, since=0):
    """Check that from a scan on the pose is no worse than odometry makes it, and the sigma grows."""
    drift = np.abs(outcome.metres[since:] - outcome.metres[since]).max()
    odometry = np.hypot(*outcome.odometry[:, :2].T)
    assert drift < 2.0 * max(0.1, odometry.max())
    assert outcome.sigma[-1] > 0.25
    assert outcome.sigma[-1] > 2.0 * outcome.sigma[since + 10]
    assert outcome.metres[-1] < 3.0 * outcome.sigma[-1]
    assert (outcome.nees < WITHIN).mean() > 0.9


def test_a_lidar_of_eight_beams_leaves_dead_reckoning():
    turn = 2.0 * math.pi
    look = {"beams": 8, "angle_min": -math.pi, "angle_step": turn / 8, "beam_time": 0.01}
    outcome = Outcome(recorded(hall(), **look))
    dead_reckoned(outcome)
    assert outcome.states[-1] == "DEGRADED"
    assert "no known feature was seen" in outcome.words


@pytest.mark.parametrize("since", [0, 150])
def test_scans_without_an_echo_leave_dead_reckoning(plain, since):
    begin = [m.stamp for m in plain if isinstance(m, LaserScan)][since]
    outcome = Outcome(spoilt(plain, lambda m: m.ranges * (m.stamp < begin)))
    dead_reckoned(outcome, since)
    assert "TRACKING" not in outcome.states[since + 1 :]


@pytest.mark.parametrize("since", [0, 150])
def test_a_robot_that_sees_noise_alone_is_lost_and_leaves_the_map_as_it_was(plain, since):
    """The path in the map ends there; at the time, the pose goes on by dead reckoning."""
    rng = np.random.default_rng(0)
    begin = [m.stamp for m in plain if isinstance(m, LaserScan)][since]

    def noise(m):
        return m.ranges if m.stamp < begin else rng.uniform(0.3, 5.0, len(m.ranges))

    outcome = Outcome(spoilt([m for m in plain if m.stamp < begin + 20.0], noise))
    assert set(outcome.states[since + 20 :]) == {"LOST"}
    assert since < len(outcome.metres) < since + 20
    assert outcome.metres.max() < 0.3
    odometry = np.hypot(*outcome.odometry[:, :2].T).max()
    off = np.hypot(*outcome.live[:, :2].T)
    assert np.abs(off[since:] - off[since]).max() < 2.0 * max(0.3, odometry)


def test_a_crowd_neither_moves_the_pose_nor_ends_the_run():
    rng = np.random.default_rng(0)
    people = [
        {"waypoints": way.tolist(), "speed": speed, "returns": True}
        for way, speed in zip(
            rng.uniform([0.6, 0.6], [10.4, 5.4], (20, 6, 2)), rng.uniform(0.6, 1.4, 20), strict=True
        )
    ]
    outcome = Outcome(recorded(hall(people=people)))
    assert outcome.metres.max() < 0.3
    assert outcome.metres[-1] < 0.1
    assert (outcome.nees < WITHIN).mean() > 0.95


def test_beams_that_pass_glass_or_vanish_in_it_do_not_move_the_pose(plain):
    rng = np.random.default_rng(0)
    opened = [m for m in recorded(hall(core=CORE[:-1])) if isinstance(m, LaserScan)]
    behind = {m.stamp: m.ranges for m in opened}  # without the side of the core that is of glass

    def glass(m):
        met = np.abs(m.ranges - behind[m.stamp]) > 0.1
        fate = rng.random(len(m.ranges))
        passed = np.where(fate < 0.6, behind[m.stamp], np.where(fate < 0.8, 0.0, m.ranges))
        return np.where(met, passed, m.ranges)

    outcome = Outcome(spoilt(plain, glass))
    assert outcome.metres.max() < 0.15
    assert outcome.metres[-1] < 0.05
    assert (outcome.nees < WITHIN).mean() > 0.95
