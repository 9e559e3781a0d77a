"""Calibration of a robot from logs: read, matched, solved, and said in the config's own keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from impslam.calibration import noise
from impslam.calibration.closed_form import LATENCIES, first_estimate
from impslam.calibration.gyro import gyro_of
from impslam.calibration.least_squares import Prior, Solution, solve
from impslam.calibration.lidar_path import lidar_path
from impslam.calibration.odometry_models import covered, model_of
from impslam.calibration.order_clock import MOST, in_order
from impslam.calibration.recording import Recording, lidar_of
from impslam.calibration.residuals import SENSOR, Drive
from impslam.calibration.scan_pairs import matched_pairs
from impslam.config import Config
from impslam.errors import ConfigError, SourceError
from impslam.odometry.base import Odometry
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Mask

FEWEST = 10
"""Motions of a log, below which nothing is calibrated: 3 m or a turn."""
LOOSE = 10.0
"""The prior is so many times wider than the limit of what counts as observable: it changes nothing that the
drive determines."""


class Kind(NamedTuple):
    """A parameter's unit, and the standard deviation up to which a drive tells it.

    `limit` is of the unit, or a share of the value: a few times what a ruler, a protractor and a look
    at the clock tell.
    """

    unit: str
    limit: float
    is_share: bool = False


KINDS = {
    "wheel_radius": Kind("m", 0.02, is_share=True),
    "right_left_ratio": Kind("1", 0.01),
    "track": Kind("m", 0.05, is_share=True),
    "distance_scale": Kind("1", 0.02),
    "speed_scale": Kind("1", 0.02),
    "turn_scale": Kind("1", 0.02),
    "turn_per_metre": Kind("rad/m", 0.02),
    "x": Kind("m", 0.02),
    "y": Kind("m", 0.02),
    "yaw": Kind("rad", 0.02),
    "latency": Kind("s", 0.02),
    "range_offset": Kind("m", 0.01),
    "range_scale": Kind("1", 0.02),
}
LENGTHS = ("wheel_radius", "track", "distance_scale", "speed_scale")
"""What is to be known for the scale of the ranges: it and the robot's lengths are one and the same."""


class Parameter(NamedTuple):
    """A calibrated parameter.

    Attributes
    ----------
    name, unit : as in `KINDS`
    before, value : as the config has it, and as found; the same where the drive does not tell
    sigma : standard deviation of what was found; infinite if it was kept
    observable : whether the drive determines it
    """

    name: str
    unit: str
    before: float
    value: float
    sigma: float
    observable: bool


class Spread(NamedTuple):
    """A standard deviation of odometry or of matches, and its own; names as in `noise.names`."""

    name: str
    unit: str
    value: float
    sigma: float


class Calibration(NamedTuple):
    """What drives tell of a robot.

    Attributes
    ----------
    lidar : name of the lidar in the config
    parameters, covariance : (n,) of odometry and lidar, and (n, n), 0 where not observable
    spreads : of odometry and of matches
    drives, solution : what it rests on
    start : (n,) the parameters by the config, as `residuals` takes them
    """

    lidar: str
    parameters: tuple[Parameter, ...]
    covariance: Array
    spreads: tuple[Spread, ...]
    drives: tuple[Drive, ...]
    solution: Solution
    start: Array


def drives_of(config: Config, recording: Recording, where: str) -> list[Drive]:
    """Return what one log has for a calibration, a drive for each piece of its odometry.

    Raises
    ------
    SourceError
        If it has no odometry, or too little motion.
    """
    odometry, (_, lidar) = config.make_robot().odometry, lidar_of(config)
    if not odometry.measures_motion or not recording.odometry:
        raise SourceError(
            f"{where}: has no {odometry.consumes.__name__} to calibrate; record odometry, or choose "
            "what the log has with --set odometry.kind="
        )
    recording, disorder = in_order(recording)
    path = lidar_path(lidar, recording.scans)
    found, slack = matched_pairs(lidar, recording.scans, path), float(LATENCIES[-1])
    gyro = gyro_of(recording.gyro, found, lidar.latency) if disorder <= MOST else None
    out = list[Drive]()
    for readings in recording.odometry:
        if len(readings) > 1:
            model = model_of(odometry, readings)
            begins, ends = found.begins - lidar.latency, found.ends - lidar.latency
            inside = covered(model, begins - slack, ends + slack)
            out.append(Drive(model, found.take(np.flatnonzero(inside)), path, gyro, disorder))
    count = sum(len(drive.motions.begins) for drive in out)
    if count < FEWEST:
        raise SourceError(
            f"{where}: {count} motions of the lidar were matched, and {FEWEST} are needed; drive 10 m "
            "with turns to both sides, near walls"
        )
    return out


def calibrate(config: Config, drives: Sequence[Drive], keep: Sequence[str] = ()) -> Calibration:
    """Return the parameters that fit all drives of a robot best.

    `keep` names parameters of `KINDS` that stay as the config has them. If one of them is a length of
    the robot, the scale of the ranges is found.

    Raises
    ------
    ConfigError
        If `keep` names something else.
    """
    odometry, (name, lidar) = config.make_robot().odometry, lidar_of(config)
    names = (*drives[0].model.names, *SENSOR)
    _check(keep, names)
    before = _before(odometry, lidar, drives[0].model.names)
    limits = np.array([_limit(one, value) for one, value in zip(names, before, strict=True)])
    free = np.array([one not in keep for one in names])
    if not set(keep) & set(LENGTHS):
        free[names.index("range_scale")] = False
    start = before.copy()
    start[-2:] = 0.0, 1.0
    prior = Prior(start, LOOSE * limits)
    solution = solve(drives, _begin(drives, prior, free), free, prior)
    sigmas = np.sqrt(np.diag(solution.covariance))
    observable = free & (sigmas <= limits)
    if (observable != free).any():
        solution = solve(
            drives, np.where(observable, solution.parameters, start), observable, prior
        )
    disorder = max(drive.disorder for drive in drives)
    if disorder > MOST:
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
    spreads = _spreads(drives[0], solution)
    return Calibration(name, parameters, covariance, spreads, tuple(drives), solution, start)


def _begin(drives: Sequence[Drive], prior: Prior, free: Mask) -> Array:
    """Return where to begin: the closed form, unless the drives tell too little for it.

    A robot may look backwards whatever its config says, but is not ten times as large.
    """
    first = first_estimate(drives, float(prior.values[-3]))
    if first is None:
        return prior.values
    off = np.abs(first - prior.values) / prior.sigmas
    off[-4] = 0.0  # the yaw
    return np.where(free, first, prior.values) if off.max() < LOOSE else prior.values


def _check(keep: Sequence[str], names: Sequence[str]) -> None:
    for one in keep:
        if one not in names:
            raise ConfigError(f"--keep {one}: no such parameter; there are {', '.join(names)}")


def _before(odometry: Odometry, lidar: Lidar2D, names: Sequence[str]) -> Array:
    """Return the parameters as the config has them."""
    own = [float(getattr(odometry, name)) for name in names]
    return np.array([*own, *lidar.mount, lidar.latency, lidar.range_offset, lidar.range_scale])


def _in_config(found: Array, lidar: Lidar2D) -> Array:
    """Return parameters as the config has them: true = scale * measured + offset."""
    out, (offset, scale) = found.copy(), found[-2:]
    out[-2:] = scale * (lidar.range_offset + offset), scale * lidar.range_scale
    return out


def _limit(name: str, value: float) -> float:
    kind = KINDS[name]
    return kind.limit * (value if kind.is_share else 1.0)


def _spreads(drive: Drive, solution: Solution) -> tuple[Spread, ...]:
    """Return the standard deviations of matches, and of odometry with its slips."""
    names, m = noise.names(drive), len(noise.MATCHING)
    of_matches = zip(names[:m], *_roots(solution.noise), strict=False)
    of_odometry = zip(names[m:], *_roots(solution.slip), strict=True)
    return tuple(
        Spread(name, noise.UNITS[name.rpartition(".")[2]], value, sigma)
        for name, value, sigma in (*of_matches, *of_odometry)
    )


def _roots(found: noise.Noise) -> tuple[list[float], list[float]]:
    """Return standard deviations (c,) and their own: that of sqrt(v) is that of v over 2 sqrt(v)."""
    sigmas = np.sqrt(np.diag(np.linalg.pinv(found.information, hermitian=True)))
    values = np.sqrt(found.variances)
    small = found.variances <= sigmas
    own = np.where(small, np.sqrt(sigmas), 0.5 * sigmas / np.where(small, 1.0, values))
    return values.tolist(), own.tolist()


def table(calibration: Calibration) -> dict[str, Any]:
    """Return what was found as a config's tables: what the drives determined, and the noise of odometry."""
    found = {one.name: one.value for one in calibration.parameters if one.observable}
    every = {one.name: one.value for one in calibration.parameters}
    lidar: dict[str, Any] = {
        name: found[name] for name in ("latency", "range_offset", "range_scale") if name in found
    }
    if found.keys() & {"x", "y", "yaw"}:
        lidar["mount"] = [every["x"], every["y"], every["yaw"]]
    odometry: dict[str, Any] = {name: found[name] for name in found if name not in SENSOR}
    for spread in calibration.spreads:
        if spread.name in noise.MATCHING:
            continue
        group, _, name = spread.name.rpartition(".")
        (odometry.setdefault(group, {}) if group else odometry)[name] = spread.value
    if "slip" in odometry:
        odometry["slip"]["forward"] = 0.0  # wheel_noise tells it
    return {"odometry": odometry, "sensors": {calibration.lidar: lidar}}
