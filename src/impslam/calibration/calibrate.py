"""Calibrate a robot from logs, and express the result in the keys of its config."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from impslam.calibration import noise
from impslam.calibration.closed_form import LATENCIES, initial_estimate
from impslam.calibration.gyro import calibrate_gyro
from impslam.calibration.least_squares import LeastSquaresSolution, Prior, solve
from impslam.calibration.lidar_path import lidar_path
from impslam.calibration.odometry_models import covered, make_model
from impslam.calibration.order_clock import MAX_DISORDER, reorder_stamps
from impslam.calibration.recording import CalibrationRows, first_lidar
from impslam.calibration.residuals import LIDAR_PARAMETERS, CalibrationDrive
from impslam.calibration.scan_pairs import match_pairs
from impslam.columns import Columns
from impslam.config import Config
from impslam.errors import ConfigError, SourceError
from impslam.odometry.base import Odometry
from impslam.odometry.stream import OdometryStream
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Mask

MIN_MOTIONS = 10
"""Motions of a log needed for a calibration: 3 m or a turn."""
PRIOR_WIDTH = 10.0
"""Standard deviations of the prior, in limits of observability: wide enough not to affect parameters that
the drives determine."""


class ParameterKind(NamedTuple):
    """A parameter's unit, and the standard deviation up to which it counts as observable.

    `limit` is in the unit, or a share of the value: a few times the accuracy of a ruler, a protractor and a
    clock.
    """

    unit: str
    limit: float
    is_share: bool = False


KINDS = {
    "wheel_radius": ParameterKind("m", 0.02, is_share=True),
    "right_left_ratio": ParameterKind("1", 0.01),
    "track": ParameterKind("m", 0.05, is_share=True),
    "distance_scale": ParameterKind("1", 0.02),
    "speed_scale": ParameterKind("1", 0.02),
    "turn_scale": ParameterKind("1", 0.02),
    "turn_per_metre": ParameterKind("rad/m", 0.02),
    "x": ParameterKind("m", 0.02),
    "y": ParameterKind("m", 0.02),
    "yaw": ParameterKind("rad", 0.02),
    "latency": ParameterKind("s", 0.02),
    "range_offset": ParameterKind("m", 0.01),
    "range_scale": ParameterKind("1", 0.02),
}
LENGTHS = ("wheel_radius", "track", "distance_scale", "speed_scale")
"""Lengths of the robot, one of which must be kept to find the scale of the ranges: they scale together."""
TURNING = ("right_left_ratio", "track", "turn_scale", "turn_per_metre")
"""Factors of turns; their errors are the systematic errors of odometry."""


class Parameter(NamedTuple):
    """A calibrated parameter.

    Attributes
    ----------
    name, unit : as in `KINDS`
    before, value : as in the config, and as calibrated; equal if it is not observable
    sigma : standard deviation of the calibrated value; infinite if it was kept
    observable : whether the drives determine it
    """

    name: str
    unit: str
    before: float
    value: float
    sigma: float
    observable: bool


class RandomError(NamedTuple):
    """A standard deviation of odometry or matches, with its own; names as in `noise_names`."""

    name: str
    unit: str
    value: float
    sigma: float


class Calibration(NamedTuple):
    """Calibration of a robot.

    Attributes
    ----------
    lidar : name of the lidar in the config
    parameters, covariance : (n,) of odometry and lidar, and (n, n), 0 if not observable
    random_errors : of odometry and of matches
    drives, solution : input, and solution of least squares
    start : (n,) the parameters of the config, for `residuals`
    """

    lidar: str
    parameters: tuple[Parameter, ...]
    covariance: Array
    random_errors: tuple[RandomError, ...]
    drives: tuple[CalibrationDrive, ...]
    solution: LeastSquaresSolution
    start: Array


def extract_drives(
    config: Config, recording: CalibrationRows, where: str
) -> list[CalibrationDrive]:
    """Return the drives of one log, one for each piece of its odometry.

    Raises
    ------
    SourceError
        If it has no odometry that moves, or too little motion.
    """
    odometry, (_, lidar) = config.make_robot().odometry, first_lidar(config)
    if not odometry.measures_motion or not recording.odometry:
        # An odometry that measures nothing reads scans, which are not what is missing.
        missing = odometry.consumes.__name__ if odometry.measures_motion else "odometry"
        raise SourceError(
            f"{where}: has no {missing} to calibrate; record odometry, or choose the kind that the log "
            "has with --set odometry.kind="
        )
    if not _moves(odometry, recording.odometry):
        raise SourceError(
            f"{where}: its odometry stands still; `imp inspect` shows whether the log has another one, or "
            "what to set"
        )
    recording, disorder = reorder_stamps(recording)
    path = lidar_path(lidar, recording.scans)
    found, slack = match_pairs(lidar, recording.scans, path), float(LATENCIES[-1])
    gyro = (
        calibrate_gyro(recording.gyro, found, lidar.latency) if disorder <= MAX_DISORDER else None
    )
    out = list[CalibrationDrive]()
    for readings in recording.odometry:
        if len(readings) > 1:
            model = make_model(odometry, readings)
            begins, ends = found.begins - lidar.latency, found.ends - lidar.latency
            inside = covered(model, begins - slack, ends + slack)
            out.append(
                CalibrationDrive(model, found.take(np.flatnonzero(inside)), path, gyro, disorder)
            )
    count = sum(len(drive.motions.begins) for drive in out)
    if count < MIN_MOTIONS:
        raise SourceError(
            f"{where}: {count} motions of the lidar were matched, and {MIN_MOTIONS} are needed; drive 10 m "
            "with turns to both sides, near walls"
        )
    return out


def _moves(odometry: Odometry, pieces: Sequence[Columns]) -> bool:
    """Return whether odometry reports any motion."""
    rows = (
        OdometryStream(odometry).motions(piece).motions.d_pose for piece in pieces if len(piece)
    )
    return any((np.abs(d_pose) > 0.0).any() for d_pose in rows)


def calibrate(
    config: Config, drives: Sequence[CalibrationDrive], keep: Sequence[str] = ()
) -> Calibration:
    """Return the parameters that fit all drives of a robot best.

    `keep` names parameters of `KINDS` that keep their configured value. If one of them is a length of the
    robot, the scale of the ranges is calibrated too.

    Raises
    ------
    ConfigError
        If `keep` names something else.
    """
    odometry, (name, lidar) = config.make_robot().odometry, first_lidar(config)
    names = (*drives[0].model.names, *LIDAR_PARAMETERS)
    _check(keep, names)
    before = _before(odometry, lidar, drives[0].model.names)
    limits = np.array([_limit(one, value) for one, value in zip(names, before, strict=True)])
    free = np.array([one not in keep for one in names])
    if not set(keep) & set(LENGTHS):
        free[names.index("range_scale")] = False
    start = before.copy()
    start[-2:] = 0.0, 1.0
    prior = Prior(start, PRIOR_WIDTH * limits)
    solution = solve(drives, _begin(drives, prior, free), free, prior)
    sigmas = np.sqrt(np.diag(solution.covariance))
    observable = free & (sigmas <= limits)
    if (observable != free).any():
        solution = solve(
            drives, np.where(observable, solution.parameters, start), observable, prior
        )
    disorder = max(drive.disorder for drive in drives)
    if disorder > MAX_DISORDER:
        late = names.index("latency")
        observable[late], sigmas[late] = False, disorder
    sigmas = np.where(
        observable, np.sqrt(np.diag(solution.covariance)), np.where(free, sigmas, np.inf)
    )
    covariance = solution.covariance * np.outer(observable, observable)
    after = _in_config(solution.parameters, lidar)
    parameters = tuple(
        Parameter(*row)
        for row in zip(names, [KINDS[one].unit for one in names], before.tolist(),
                       np.where(observable, after, before).tolist(), sigmas.tolist(),
                       observable.tolist(), strict=True)
    )  # fmt: skip
    random_errors = _random_errors(drives[0], solution)
    return Calibration(name, parameters, covariance, random_errors, tuple(drives), solution, start)


def _begin(drives: Sequence[CalibrationDrive], prior: Prior, free: Mask) -> Array:
    """Return the start: the closed-form estimate, or the prior if that estimate is too far from it.

    The yaw may be anything, as a lidar may face backward, but a robot is not ten times as large.
    """
    first = initial_estimate(drives, float(prior.values[-3]))
    if first is None:
        return prior.values
    off = np.abs(first - prior.values) / prior.sigmas
    off[-4] = 0.0  # the yaw
    return np.where(free, first, prior.values) if off.max() < PRIOR_WIDTH else prior.values


def _check(keep: Sequence[str], names: Sequence[str]) -> None:
    for one in keep:
        if one not in names:
            raise ConfigError(f"--keep {one}: no such parameter; there are {', '.join(names)}")


def _before(odometry: Odometry, lidar: Lidar2D, names: Sequence[str]) -> Array:
    """Return the configured parameters."""
    own = [float(getattr(odometry, name)) for name in names]
    return np.array([*own, *lidar.mount, lidar.latency, lidar.range_offset, lidar.range_scale])


def _in_config(found: Array, lidar: Lidar2D) -> Array:
    """Return parameters in the config's convention: true = scale * measured + offset."""
    out, (offset, scale) = found.copy(), found[-2:]
    out[-2:] = scale * (lidar.range_offset + offset), scale * lidar.range_scale
    return out


def _limit(name: str, value: float) -> float:
    kind = KINDS[name]
    return kind.limit * (value if kind.is_share else 1.0)


def _random_errors(
    drive: CalibrationDrive, solution: LeastSquaresSolution
) -> tuple[RandomError, ...]:
    """Return the standard deviations of matches, and of odometry including slip."""
    names, m = noise.noise_names(drive), len(noise.MATCHING)
    of_matches = zip(names[:m], *_roots(solution.noise), strict=False)
    of_odometry = zip(names[m:], *_roots(solution.slip), strict=True)
    return tuple(
        RandomError(name, noise.UNITS[name.rpartition(".")[2]], value, sigma)
        for name, value, sigma in (*of_matches, *of_odometry)
    )


def _roots(found: noise.ErrorVariances) -> tuple[list[float], list[float]]:
    """Return c standard deviations and their own: that of sqrt(v) is that of v over 2 sqrt(v)."""
    sigmas = np.sqrt(np.diag(np.linalg.pinv(found.information, hermitian=True)))
    values = np.sqrt(found.variances)
    small = found.variances <= sigmas
    own = np.where(small, np.sqrt(sigmas), 0.5 * sigmas / np.where(small, 1.0, values))
    return values.tolist(), own.tolist()


def config_tables(calibration: Calibration) -> dict[str, Any]:
    """Return the observable parameters and the noise of odometry as tables of a config."""
    found = {one.name: one.value for one in calibration.parameters if one.observable}
    every = {one.name: one.value for one in calibration.parameters}
    lidar: dict[str, Any] = {
        name: found[name] for name in ("latency", "range_offset", "range_scale") if name in found
    }
    if found.keys() & {"x", "y", "yaw"}:
        lidar["mount"] = [every["x"], every["y"], every["yaw"]]
    odometry: dict[str, Any] = {name: found[name] for name in found if name not in LIDAR_PARAMETERS}
    for spread in calibration.random_errors:
        if spread.name in noise.MATCHING:
            continue
        group, _, name = spread.name.rpartition(".")
        (odometry.setdefault(group, {}) if group else odometry)[name] = spread.value
    if "slip" in odometry:
        odometry["slip"]["forward"] = 0.0  # included in wheel_noise
    if all(one.observable for one in calibration.parameters if one.name in TURNING):
        odometry["slip" if "slip" in odometry else "noise"]["systematic"] = 0.0
    return {"odometry": odometry, "sensors": {calibration.lidar: lidar}}
