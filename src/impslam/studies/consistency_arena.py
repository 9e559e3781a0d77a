"""Is the whole system's uncertainty true? The simulated arena, mapped from its raw readings.

Here noise is not what the filter is told: ranges share an error, edges mix, wheels slip. The preset
allows for that with more noise than there is in a simulated room. How much of what comes out is due
to which allowance shows where the fault is switched off and the preset told so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.config import load
from impslam.evaluation.consistency import nees, pose_errors, share_within
from impslam.evaluation.landmarks import score_landmarks
from impslam.geometry.angles import wrap
from impslam.pipeline import Pipeline
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.studies.arena_runs import arena, true_landmarks
from impslam.studies.base import Job
from impslam.types import Array, Landmark, Message, StepResult, TrueLandmark, TruePose

FILTERS = ("ekf", "riekf")
KINDS = ("cylinder", "wall", "corner")
SETTLED = 2.0
"""s; until the robot has left the start its errors are 0 by definition, and tell nothing."""


@dataclass(frozen=True)
class Case:
    """What is simulated, what the preset is told of it, and which filters run over it."""

    name: str
    robot: SimulatedRobot
    settings: tuple[str, ...] = ()
    filters: tuple[str, ...] = FILTERS


def _robot(encoders: WheelEncoders | None = None, lidar: Lidar | None = None) -> SimulatedRobot:
    """Return the robot without what the preset does not listen to, which saves a second a run."""
    encoders, lidar = encoders or WheelEncoders(), lidar or Lidar()
    return SimulatedRobot(encoders=encoders, lidar=lidar, imu=None, truth_rate=1.0)


_NO_SLIP = WheelEncoders(radius_sigma=0.0, track_sigma=0.0, slip_sigma=0.0, skid_rate=0.0)
_TOLD_NO_SLIP = tuple(
    f"odometry.slip.{name}=0.0"
    for name in ("forward", "sideways", "turn_per_distance", "turn_per_turn")
)
_TOLD_EXACT = (
    "sensors.lidar.bias=0.0",
    "sensors.lidar.extractors.walls.flatness=0.0",
    "sensors.lidar.extractors.corners.flatness=0.0",
)
CASES = (
    Case("as it is", _robot()),
    Case("no slip, and told so", _robot(_NO_SLIP), _TOLD_NO_SLIP, FILTERS[-1:]),
    Case(
        "nor bias nor mixed pixels, walls told flat",
        _robot(_NO_SLIP, Lidar(bias_sigma=0.0, divergence=0.0)),
        (*_TOLD_NO_SLIP, *_TOLD_EXACT),
        FILTERS[-1:],
    ),
)


@dataclass(frozen=True)
class Sample:
    """What one filter made of one run.

    `times` (n,) s and pose NEES (n,) by scan; by kind the mean NIS over its dimension of single
    observations, and the mean NEES of the landmarks in their reported form at the end of the run.
    """

    times: Array
    nees: Array
    nis: Mapping[str, float]
    landmarks: Mapping[str, float]


@dataclass(frozen=True)
class Outcome:
    """Means over the runs of a case and a filter, like `Sample`; NaN for a kind never seen."""

    case: str
    filter: str
    runs: int
    times: Array
    nees: Array
    nis: Mapping[str, float]
    landmarks: Mapping[str, float]

    @property
    def mean(self) -> float:
        """Mean pose NEES over time, ideally 3."""
        return float(self.nees[self.times >= SETTLED].mean())

    @property
    def in_band(self) -> float:
        """Share of scans at which the mean over the runs lies within its 95 % interval."""
        return share_within(self.nees[self.times >= SETTLED], self.runs, 3)


def whole_system(job: Job, runs: int, cases: Sequence[Case] = CASES) -> list[Outcome]:
    """Simulate, map and judge the arena; cases after the first get half the runs."""
    tasks = [
        (case, seed)
        for number, case in enumerate(cases)
        for seed in range(runs if number == 0 else max(1, runs // 2))
    ]
    results = job.map(judge, tasks, "arena")
    outcomes = []
    for case in cases:
        own = [result for (other, _), result in zip(tasks, results, strict=True) if other is case]
        outcomes += [_outcome(case.name, name, [r[name] for r in own]) for name in case.filters]
    return outcomes


def judge(task: tuple[Case, int]) -> dict[str, Sample]:
    """Run a case's filters over the run of a seed."""
    case, seed = task
    messages = list(simulate(arena(), case.robot, seed))
    start = list(map(float, arena().robot.start))
    settings = [f"start={start}", f"seed={seed}", *case.settings]
    return {
        name: sample(messages, true_landmarks(), [*settings, f"filter.kind={name}"])
        for name in case.filters
    }


def sample(
    messages: Sequence[Message], truth: Sequence[TrueLandmark], settings: Sequence[str]
) -> Sample:
    """Run the preset over the messages and compare it with the true poses among them."""
    pipeline = Pipeline(load("imp", settings))
    steps = list(pipeline.play(messages))
    poses = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    errors = pose_errors(
        np.array([step.pose for step in steps]), np.array([poses[step.stamp] for step in steps])
    )
    stamps = np.array([step.stamp for step in steps])
    return Sample(
        stamps - stamps[0],
        nees(errors, np.array([step.covariance for step in steps])),
        nis_by_kind(steps),
        landmark_nees(pipeline.slam.landmarks(), truth),
    )


def nis_by_kind(steps: Iterable[StepResult]) -> dict[str, float]:
    """Return the mean over all matches of a kind of their NIS, over its dimension: ideally 1."""
    found: dict[str, list[float]] = {}
    for step in steps:
        for match in step.matches:
            kind = step.observations[match.observation].kind
            found.setdefault(kind, []).append(match.distance2 / len(match.innovation))
    return {kind: float(np.mean(values)) for kind, values in found.items()}


def landmark_nees(estimates: Sequence[Landmark], truth: Sequence[TrueLandmark]) -> dict[str, float]:
    """Return the mean NEES by kind: of [x, y] of points, of [r, alpha] of walls; ideally 2."""
    by_id = {mark.id: mark for mark in estimates}
    by_name = {true.name: true for true in truth}
    found: dict[str, list[float]] = {}
    for match in score_landmarks(estimates, truth).found:
        mark, true = by_id[match.id], by_name[match.name]
        error = reported_error(mark, true)
        value = nees(error[None], mark.covariance[None])[0]
        found.setdefault(mark.kind, []).append(float(value))
    return {kind: float(np.mean(values)) for kind, values in found.items()}


def reported_error(mark: Landmark, true: TrueLandmark) -> Array:
    """Return the error (2,) of the values that a landmark's covariance speaks of."""
    if mark.kind != "wall":
        return mark.position - true.position
    r, alpha = (mark.parameters[name] - true.parameters[name] for name in ("r", "alpha"))
    return np.array([r, wrap(alpha)])


def _outcome(case: str, name: str, samples: Sequence[Sample]) -> Outcome:
    last = min(len(s.nees) for s in samples)
    return Outcome(
        case,
        name,
        len(samples),
        samples[0].times[:last],
        np.mean([s.nees[:last] for s in samples], axis=0),
        {kind: _mean([s.nis for s in samples], kind) for kind in KINDS},
        {kind: _mean([s.landmarks for s in samples], kind) for kind in KINDS},
    )


def _mean(by_kind: Sequence[Mapping[str, float]], kind: str) -> float:
    known = [values[kind] for values in by_kind if kind in values]
    return float(np.mean(known)) if known else float("nan")
