"""The arena of the thesis, driven with a seed and mapped in several ways, each scored by the truth."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impslam.config import Config, load
from impslam.evaluation.consistency import nees, pose_errors
from impslam.evaluation.landmarks import LandmarkScore, corners, score_landmarks
from impslam.geometry.se2 import compose
from impslam.pipeline import Pipeline
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World, load_world
from impslam.studies.base import Job
from impslam.types import Array, Landmark, Message, TrueLandmark, TruePose

WORLD = "arena"
OFF = 0.3
"""m: only runs whose dead reckoning ends this far from the truth show what the map is worth."""


@dataclass(frozen=True, slots=True)
class Way:
    """A way to map: a preset, and settings on top of it."""

    preset: str
    settings: tuple[str, ...] = ()

    def config(self, seed: int) -> Config:
        """Return the config, with the start of the arena's drive."""
        start = list(map(float, arena().robot.start))
        return load(self.preset, [f"start={start}", f"seed={seed}", *self.settings])


DEFAULT = Way("imp")


@dataclass(frozen=True, slots=True, eq=False)
class ArenaRun:
    """One drive through the arena, mapped in one way.

    Attributes
    ----------
    seed : of all noise
    path, odometry, truth : (n, 3) poses in map at the stamps of the n scans
    nees : (n,) normalised error squared of the pose
    landmarks : the map at the end
    """

    seed: int
    path: Array
    odometry: Array
    truth: Array
    nees: Array
    landmarks: tuple[Landmark, ...]

    @property
    def end(self) -> float:
        """How far the estimate ends from the truth, m."""
        return float(math.dist(self.path[-1, :2], self.truth[-1, :2]))

    @property
    def wheels(self) -> float:
        """How far dead reckoning ends from the truth, m."""
        return float(math.dist(self.odometry[-1, :2], self.truth[-1, :2]))

    def score(self, gate: float = 0.5) -> LandmarkScore:
        """Score the map against all walls, cylinders, and corners where walls meet."""
        return score_landmarks(self.landmarks, true_landmarks(), gate)


@functools.cache
def arena() -> World:
    """Return the world."""
    return load_world(WORLD)


@functools.cache
def true_landmarks() -> tuple[TrueLandmark, ...]:
    """Return its walls and cylinders as they are named, and the corners that the walls make."""
    named = arena().landmarks()
    return (*named, *corners(named))


def map_arena(messages: Sequence[Message], seed: int, way: Way) -> ArenaRun:
    """Map what the robot recorded."""
    pipeline = Pipeline(way.config(seed))
    steps = list(pipeline.play(messages))
    truth = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    true = np.array([truth[step.stamp] for step in steps])
    path = np.array([step.pose for step in steps])
    covariances = np.array([step.covariance for step in steps])
    return ArenaRun(
        seed,
        path,
        np.array([step.odometry for step in steps]),
        true,
        nees(pose_errors(path, true), covariances),
        pipeline.slam.landmarks(),
    )


def drive_and_map(task: tuple[int, tuple[Way, ...]]) -> list[ArenaRun]:
    """Simulate one seed and map it in several ways."""
    seed, ways = task
    messages = list(simulate(arena(), seed=seed))
    return [map_arena(messages, seed, way) for way in ways]


_KEPT: dict[tuple[int, Way], ArenaRun] = {}
"""Runs made in this process: the three experiments share what they have in common."""


def runs(job: Job, seeds: Sequence[int], ways: Sequence[Way]) -> list[list[ArenaRun]]:
    """Return the runs of every way, in the order of the seeds."""
    todo = [(s, tuple(w for w in ways if (s, w) not in _KEPT)) for s in seeds]
    todo = [task for task in todo if task[1]]
    made = job.map(drive_and_map, todo, "drive and map the arena") if todo else []
    for (seed, missing), done in zip(todo, made, strict=True):
        _KEPT.update({(seed, way): run for way, run in zip(missing, done, strict=True)})
    return [[_KEPT[seed, way] for seed in seeds] for way in ways]


_WHEELS: dict[int, float] = {}


def dead_reckoning(seed: int) -> float:
    """Return how far the wheels alone end from the truth, m; nothing is estimated for it."""
    wheels = SimulatedRobot(lidar=None, imu=None, truth_rate=1.0)
    config = DEFAULT.config(seed)
    odometry, pose, truth = config.make_robot().odometry, np.array(config.start), np.zeros(3)
    for message in simulate(arena(), wheels, seed):
        if isinstance(message, TruePose):
            truth = message.pose
        elif (increment := odometry.update(message)) is not None:
            pose = compose(pose, increment.d_pose)
    return float(math.dist(pose[:2], truth[:2]))


def drifting(job: Job, number: int) -> list[int]:
    """Return the first seeds 0, 1, ... whose dead reckoning ends `OFF` from the truth or more."""
    found: list[int] = []
    begin = 0
    while len(found) < number:
        batch = range(begin, begin + number)
        unknown = [seed for seed in batch if seed not in _WHEELS]
        ends = job.map(dead_reckoning, unknown, "dead reckoning") if unknown else []
        _WHEELS.update(zip(unknown, ends, strict=True))
        found += [seed for seed in batch if _WHEELS[seed] >= OFF]
        begin += number
    return found[:number]
