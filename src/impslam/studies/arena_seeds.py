"""Seeds of the arena with enough drift of dead reckoning: without drift, a map makes no difference."""

from __future__ import annotations

import math

import numpy as np

from impslam.columns import batches
from impslam.geometry.se2 import compose
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.studies.arena_experiment import DEFAULT
from impslam.studies.sweep import Variant
from impslam.sweeps.job import Job
from impslam.types import TruePose

MIN_DRIFT = 0.3
"""m: minimum error of dead reckoning at the end of a run that is used."""


def dead_reckoning_error(seed: int) -> float:
    """Return the error of dead reckoning at the end of the drive, m; no SLAM is run for it."""
    world, robot = load_world("arena"), SimulatedRobot(lidar=None, imu=None, truth_rate=1.0)
    config = Variant(DEFAULT).config(world, seed)
    blind, truth = config.make_robot(), np.zeros(3)
    messages = ((type(message).__name__, message) for message in simulate(world, robot, seed))
    for part in batches(messages):
        blind.sense(part)
        if TruePose.__name__ in part:
            truth = part[TruePose.__name__]["pose"][-1]
    pose = compose(np.array(config.start), blind.ahead().d_pose)
    return float(math.dist(pose[:2], truth[:2]))


_DRIFT: dict[int, float] = {}
"""Cache of dead reckoning's error by seed, m: the three experiments use the same seeds."""


def drifting_seeds(job: Job, number: int) -> list[int]:
    """Return the first seeds 0, 1, ... with a drift of `MIN_DRIFT` or more."""
    found: list[int] = []
    begin = 0
    while len(found) < number:
        batch = range(begin, begin + number)
        unknown = [seed for seed in batch if seed not in _DRIFT]
        drifts = job.map(dead_reckoning_error, unknown, "dead reckoning") if unknown else []
        _DRIFT.update(zip(unknown, drifts, strict=True))
        found += [seed for seed in batch if _DRIFT[seed] >= MIN_DRIFT]
        begin += number
    return found[:number]
