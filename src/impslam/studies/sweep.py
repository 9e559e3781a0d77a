"""Run SLAM over presets x settings x worlds x seeds, and tabulate the errors: one row per run.

For example, to tune a gate with ten drives through each of two worlds:

    settings = {f"gate {d} m": [f"association.max_distance={d}"] for d in (0.5, 1.0, 2.0)}
    rows = sweep(grid(["thesis-lines"], settings), range(10), ["arena", "room"], job=Job(processes=2))
    for name, runs in by_variant(rows).items():
        print(name, Quantiles.of(run["end"] for run in runs))
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np

from impslam.config import Config, load
from impslam.evaluation.consistency import chi2_bounds, nees, pose_errors
from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.run import Run
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World, load_world
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row, attempt
from impslam.types import Array, Landmark, Match, Message, Observation, TruePose


@dataclass(frozen=True, slots=True)
class Variant:
    """A way to map: a preset with settings, and the simulated robot."""

    name: str
    preset: str = "imp"
    settings: tuple[str, ...] = ()
    robot: SimulatedRobot = ROBOT

    def config(self, world: World, seed: int) -> Config:
        """Return the config, with the start of the world's drive."""
        start = list(map(float, world.robot.start))
        return load(self.preset, [f"start={start}", f"seed={seed}", *self.settings])


class Promotion(NamedTuple):
    """A landmark's entry into the map, with the observation that created it."""

    id: int
    stamp: float
    observation: Observation


@dataclass(frozen=True, eq=False)
class StudyRun:
    """One drive through a world, mapped by one variant.

    Attributes
    ----------
    messages : the robot's recording
    truth : (n, 3) true poses in map at the stamps of the n scans
    rows : the path, with each pose as known at its time
    matches : all observations that were matched with a landmark, with their matches
    landmarks : the map at the end
    promotions : of all landmarks that were ever in the map
    """

    world: World
    variant: Variant
    seed: int
    messages: Sequence[Message]
    truth: Array
    rows: PathRows
    matches: Sequence[tuple[Observation, Match]]
    landmarks: tuple[Landmark, ...]
    promotions: Sequence[Promotion]

    @cached_property
    def path(self) -> Array:
        """Estimated poses (n, 3) in map."""
        return self.rows.poses

    @cached_property
    def odometry(self) -> Array:
        """Poses (n, 3) by dead reckoning, in map."""
        return self.rows.odometry

    @cached_property
    def errors(self) -> Array:
        """Distances (n,) of the path from the truth, m; both begin at the same pose, without alignment."""
        return np.asarray(np.hypot(*(self.path - self.truth)[:, :2].T))

    @cached_property
    def nees(self) -> Array:
        """Normalised errors squared (n,) of the poses."""
        return nees(pose_errors(self.path, self.truth), self.rows.covariances)

    @cached_property
    def travelled(self) -> Array:
        """Distance driven up to each step, (n,) m."""
        return np.cumsum(
            np.hypot(*np.diff(self.truth[:, :2], axis=0, prepend=self.truth[:1, :2]).T)
        )


class _MatchRecorder(Observer):
    """Stores the matches, and the observations from which landmarks were created."""

    def __init__(self) -> None:
        self.matches: list[tuple[Observation, Match]] = []
        self.promotions: list[Promotion] = []

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Store the matches and new landmarks of a keyframe."""
        del path
        observations = keyframe.observations
        self.matches += [(observations[match.observation], match) for match in revision.matches]
        self.promotions += [
            Promotion(number, keyframe.stamp, observations[origin])
            for number, origin in zip(revision.added, revision.origins, strict=True)
        ]


def map_run(messages: Sequence[Message], world: World, variant: Variant, seed: int) -> StudyRun:
    """Map a recording."""
    seen = _MatchRecorder()
    known = Run(variant.config(world, seed), [seen]).play(messages)
    truth = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    true = np.array([truth[stamp] for stamp in known.stamps.tolist()])
    marks = known.landmarks
    return StudyRun(
        world, variant, seed, messages, true, known.rows(), seen.matches, marks, seen.promotions
    )


def simulate_and_map(world: World, variants: Sequence[Variant], seed: int) -> dict[str, StudyRun]:
    """Simulate one seed and map it with several variants of the same robot; return runs by variant name."""
    messages = list(simulate(world, variants[0].robot, seed))
    return {variant.name: map_run(messages, world, variant, seed) for variant in variants}


def path_metrics(run: StudyRun) -> Row:
    """Return the errors of a run's path, in m, and its NEES.

    `end` is the distance of the last pose from the truth, `ate` the root mean square of all;
    `odometry_*` are those of dead reckoning. `nees` is the mean over the steps, 3 if consistent;
    `nees_within` is the share of steps below 7.81, ideally 95 %.
    """
    odometry = np.hypot(*(run.odometry - run.truth)[:, :2].T)
    return {
        "travelled": float(run.travelled[-1]),
        "end": float(run.errors[-1]),
        "ate": float(np.sqrt(np.mean(run.errors**2))),
        "odometry_end": float(odometry[-1]),
        "odometry_ate": float(np.sqrt(np.mean(odometry**2))),
        "nees": float(run.nees.mean()),
        "nees_within": float(np.mean(run.nees <= chi2_bounds(3, confidence=0.9)[1])),
    }


def no_metrics(run: StudyRun) -> Row:
    """Return no metrics beyond `path_metrics`."""
    del run
    return {}


@dataclass(frozen=True, slots=True)
class _Task:
    """One simulated drive and the variants that map it."""

    world: World
    seed: int
    variants: tuple[Variant, ...]
    measure: Callable[[StudyRun], Row]


def sweep(
    variants: Sequence[Variant],
    seeds: Iterable[int],
    worlds: Iterable[str | World] = ("arena",),
    measure: Callable[[StudyRun], Row] = no_metrics,
    job: Job | None = None,
    stage: str = "simulate and map",
) -> list[Row]:
    """Simulate every world with every seed, map it with every variant, and return a row for each run.

    Variants of the same robot map the same messages. The rows are ordered by world, seed and variant,
    independent of the number of processes. A failed run has a row with an `error` and no metrics.

    Parameters
    ----------
    measure : returns metrics beyond `path_metrics`; must be picklable
    job : processes and progress; its number of seeds is ignored

    Raises
    ------
    ConfigError
        If a variant's preset or settings are invalid, before anything runs.
    """
    known = [load_world(world) if isinstance(world, str) else world for world in worlds]
    for world in known:
        for variant in variants:
            variant.config(world, 0)
    robots = list({id(v.robot): v.robot for v in variants}.values())
    groups = [tuple(v for v in variants if v.robot is robot) for robot in robots]
    tasks = [
        _Task(world, seed, group, measure)
        for world in known
        for seed in list(seeds)
        for group in groups
    ]
    return list(chain.from_iterable((job or Job()).map(_run_task, tasks, stage)))


def _run_task(task: _Task) -> list[Row]:
    messages = list(simulate(task.world, task.variants[0].robot, task.seed))
    return [_row(task, messages, variant) for variant in task.variants]


def _row(task: _Task, messages: Sequence[Message], variant: Variant) -> Row:
    def metrics() -> Row:
        run = map_run(messages, task.world, variant, task.seed)
        return path_metrics(run) | task.measure(run)

    return attempt({"world": task.world.name, "variant": variant.name, "seed": task.seed}, metrics)


def grid(presets: Sequence[str], settings: Mapping[str, Sequence[str]]) -> list[Variant]:
    """Return a variant for every preset and every named list of settings.

    The preset is part of the name if there are several.
    """
    return [
        Variant(name if len(presets) == 1 else f"{preset} {name}".strip(), preset, tuple(values))
        for preset in presets
        for name, values in settings.items()
    ]
