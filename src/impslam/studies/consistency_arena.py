"""Consistency of the whole system: the simulated arena, mapped from its raw readings.

The noise differs from the filter's model: ranges have a common error, pixels at edges mix ranges, wheels
slip. The preset compensates with more noise than a simulated room has. To show the effect of each
compensation, the preset is told the truth, or an error is switched off in the simulation together with its
compensation in the preset.

A Bayesian filter is consistent on average over its prior, not for each value of the constants. So the last
cases draw the constants of each run from the preset itself; see `drawn_from`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.config import Config, load
from impslam.evaluation.consistency import nees, share_within
from impslam.evaluation.landmarks import landmark_errors, score_landmarks
from impslam.odometry.encoders import Encoders
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.robot import InertialUnit, Lidar, SimulatedRobot, WheelEncoders
from impslam.studies.arena_experiment import true_landmarks
from impslam.studies.sweep import StudyRun, Variant, sweep
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row, by_variant
from impslam.types import Array, Landmark, Match, Observation, TrueLandmark

FILTERS = ("ekf", "riekf")
KINDS = ("cylinder", "wall", "corner")
SETTLED = 2.0
"""s until the robot has left the start; before, errors are 0 by definition."""


@dataclass(frozen=True)
class ConsistencyCase:
    """A simulated robot with its settings and filters."""

    name: str
    robot: SimulatedRobot = ROBOT
    settings: tuple[str, ...] = ()
    filters: tuple[str, ...] = FILTERS

    def variants(self) -> list[Variant]:
        """Return a variant for each filter, by the filter's name."""
        return [
            Variant(name, "imp", (*self.settings, f"filter.kind={name}"), self.robot)
            for name in self.filters
        ]


_NO_SLIP = WheelEncoders(radius_sigma=0.0, track_sigma=0.0, slip_sigma=0.0, skid_rate=0.0)
_NO_SLIP_SETTINGS = tuple(
    f"odometry.slip.{name}=0.0"
    for name in ("forward", "sideways", "turn_per_distance", "turn_per_turn")
)
_FLAT_SETTINGS = (
    "sensors.lidar.extractors.walls.flatness=0.0",
    "sensors.lidar.extractors.corners.flatness=0.0",
)
_NOT_SIMULATED = (*_FLAT_SETTINGS, "odometry.slip.sideways=0.0", "odometry.gyro.scale=0.0")


def drawn_from(config: Config) -> SimulatedRobot:
    """Return a robot whose errors have the distributions that a config of the preset `imp` assumes.

    Wheels, bias and noise of gyro and lidar are those of the config. Wheels do not slip, because the config
    has a wrong track instead. Walls that are not flat, sideways slip and the gyro's scale are not
    simulated: the config must be told so (`_NOT_SIMULATED`).
    """
    robot = config.make_robot()
    wheels, lidar = robot.odometry, robot.sensors["lidar"]
    assert isinstance(wheels, Encoders)
    assert isinstance(lidar, Lidar2D)
    constant, gyro = wheels.slip.split()[1], wheels.gyro
    radius = constant.turn_per_distance * wheels.track / math.sqrt(2.0)  # of each of two wheels
    rate = InertialUnit().rate
    encoders = WheelEncoders(
        radius_sigma=radius, track_sigma=constant.turn, noise=wheels.wheel_noise**2,
        slip_sigma=0.0, skid_rate=0.0,
    )  # fmt: skip
    return SimulatedRobot(
        encoders=encoders,
        lidar=Lidar(sigma=lidar.sigma, sigma_rate=lidar.sigma_per_m, bias_sigma=lidar.bias),
        imu=InertialUnit(gyro_sigma=gyro.noise * math.sqrt(rate), gyro_bias_sigma=gyro.bias),
        truth_rate=ROBOT.truth_rate,
    )


_SHIPPED = SimulatedRobot(truth_rate=ROBOT.truth_rate)
_DRAWN = drawn_from(load("imp"))
_EXACT = {"encoders": _NO_SLIP, "lidar": Lidar(bias_sigma=0.0, divergence=0.0)}
CASES = (
    ConsistencyCase("as it is", _SHIPPED),
    ConsistencyCase("without IMU", filters=FILTERS[-1:]),
    ConsistencyCase(
        "walls told flat, and the bias",
        _SHIPPED,
        (*_FLAT_SETTINGS, f"sensors.lidar.bias={Lidar().bias_sigma}"),
        FILTERS[-1:],
    ),
    ConsistencyCase(
        "no IMU, no slip, and told so",
        ROBOT.model_copy(update={"encoders": _NO_SLIP}),
        _NO_SLIP_SETTINGS,
        FILTERS[-1:],
    ),
    ConsistencyCase(
        "nor bias nor mixed pixels, walls told flat",
        ROBOT.model_copy(update=_EXACT),
        (*_NO_SLIP_SETTINGS, *_FLAT_SETTINGS, "sensors.lidar.bias=0.0"),
        FILTERS[-1:],
    ),
    ConsistencyCase("errors drawn from the preset", _DRAWN, _NOT_SIMULATED, FILTERS[-1:]),
    ConsistencyCase(
        "the same without IMU",
        _DRAWN.model_copy(update={"imu": None}),
        _NOT_SIMULATED,
        FILTERS[-1:],
    ),
)


@dataclass(frozen=True)
class ArenaConsistency:
    """Means over the runs of a case and a filter.

    `times` (n,) s and mean pose NEES (n,) are by scan. By kind of landmark, `nis` is the mean NIS of single
    observations over their dimension, and `landmarks` the mean NEES of the reported landmarks at the end of
    a run; NaN for a kind that was never observed.
    """

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


def arena_consistency(
    job: Job, runs: int, cases: Sequence[ConsistencyCase] = CASES
) -> tuple[list[ArenaConsistency], list[Row]]:
    """Simulate, map and score the arena; cases after the first get half the runs.

    Returns the means by case and filter, and the rows of the runs.
    """
    results, rows = [], []
    for number, case in enumerate(cases):
        seeds = range(runs if number == 0 else max(1, runs // 2))
        stage = f"arena, {case.name}"
        made = sweep(case.variants(), seeds, measure=consistency_metrics, job=job, stage=stage)
        groups = by_variant(made)
        results += [_means(case.name, name, groups[name]) for name in case.filters]
        rows += [{"case": case.name, **row} for row in made]
    return results, rows


def consistency_metrics(run: StudyRun) -> Row:
    """Return the pose NEES (n,) by time (n,), and the means by kind of NIS and landmarks' NEES."""
    stamps = run.rows.stamps
    nis, landmarks = nis_by_kind(run.matches), landmark_nees(run.landmarks, true_landmarks())
    return {
        "times": stamps - stamps[0],
        "nees_by_time": run.nees,
        **{f"nis {kind}": nis.get(kind, np.nan) for kind in KINDS},
        **{f"nees {kind}": landmarks.get(kind, np.nan) for kind in KINDS},
    }


def nis_by_kind(matches: Iterable[tuple[Observation, Match]]) -> dict[str, float]:
    """Return the mean over all matches of a kind of their NIS, over its dimension: ideally 1."""
    found: dict[str, list[float]] = {}
    for observation, match in matches:
        ratio = match.distance2 / len(match.innovation)
        found.setdefault(observation.kind, []).append(ratio)
    return {kind: float(np.mean(values)) for kind, values in found.items()}


def landmark_nees(estimates: Sequence[Landmark], truth: Sequence[TrueLandmark]) -> dict[str, float]:
    """Return the mean NEES by kind: of [x, y] of points, of [r, alpha] of walls; ideally 2."""
    by_id = {mark.id: mark for mark in estimates}
    by_name = {true.name: true for true in truth}
    found: dict[str, list[float]] = {}
    for match in score_landmarks(estimates, truth).found:
        mark, true = by_id[match.id], by_name[match.name]
        error = landmark_errors(mark, true)
        value = nees(error[None], mark.covariance[None])[0]
        found.setdefault(mark.kind, []).append(float(value))
    return {kind: float(np.mean(values)) for kind, values in found.items()}


def _means(case: str, name: str, rows: Sequence[Row]) -> ArenaConsistency:
    last = min(len(row["times"]) for row in rows)
    curve = np.mean([row["nees_by_time"][:last] for row in rows], axis=0)
    nis, landmarks = ({kind: _mean(rows, f"{w} {kind}") for kind in KINDS} for w in ("nis", "nees"))
    return ArenaConsistency(case, name, len(rows), rows[0]["times"][:last], curve, nis, landmarks)


def _mean(rows: Sequence[Row], metric: str) -> float:
    """Return the mean over the runs with a finite metric; NaN if there are none."""
    known = [row[metric] for row in rows if np.isfinite(row[metric])]
    return float(np.mean(known)) if known else float("nan")
