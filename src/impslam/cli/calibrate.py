"""`imp calibrate`: wheels, laser pose and latency of a robot, from logs in which it turns."""

from __future__ import annotations

import json as json_text
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Base, Columns, Common, Output, Settings, Topics
from impslam.cli.progress import display
from impslam.errors import ConfigError

Written: TypeAlias = "tuple[Config, dict[str, Any], list[str]]"
"""The config that a calibration began with, what is laid over it, and lines that say how sure it is."""

if TYPE_CHECKING:
    from impslam.calibration.calibrate import Calibration
    from impslam.calibration.residuals import Drive
    from impslam.config import Config

SLIPS = 0.9
"""Share of the motions that fit at least where wheels hardly slip."""
ADVICE = {
    "x": "drive turns to both sides",
    "y": "drive turns to both sides",
    "yaw": "drive straight stretches",
    "track": "drive turns to both sides",
    "turn_scale": "drive turns to both sides",
    "latency": "change speed and turn rate often",
    "range_offset": "pass walls at an angle",
    "range_scale": "not separable from the robot's lengths: --keep wheel_radius or --keep track",
}
"""How to drive so that a parameter becomes observable."""


def calibrate(  # noqa: PLR0913  # each is an option that a user may give
    *logs: Path,
    config: Base = None,
    settings: Settings = (),
    topics: Topics = (),
    columns: Columns = (),
    keep: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = (),
    square: float | None = None,
    output: Output = None,
    json: Path | None = None,
    common: Common | None = None,
) -> None:
    """Find wheels, laser pose, latency and noise of a robot from logs in which it turns.

    The motion of the lidar, from its scans alone, is compared with odometry. Each parameter comes with
    its standard deviation. A parameter that the drives do not make observable stays as it is.

    Parameters
    ----------
    logs
        Logs of one robot, whose wheels and mounts are the same in all of them.
    keep
        A parameter that stays as it is: --keep wheel_radius. The scale of the ranges is found if a
        length of the robot is kept.
    square
        UMBmark: each log is a square with sides of so many m that ends where it began, some to the
        left and some to the right. Only wheels and track are found.
    output
        Write the config to run with (TOML), and the picture of before and after (PNG) beside it.
    json
        Write all numbers: a JSON file.
    """
    from impslam.cli.job import settings_of

    if not logs:
        raise ConfigError("no log given; name one or more logs of one robot")
    if output is not None and output.suffix.lower() != ".toml":
        raise ConfigError(f"{output}: is written as TOML; give -o NAME.toml")
    every = settings_of(settings, topics, columns)
    quiet = common is not None and common.quiet
    if square is not None:
        from impslam.cli.umbmark import show_squares

        above = show_squares(logs, config, every, square, quiet)
    else:
        above = _solved(logs, config, every, keep, output, json, quiet)
    if output is not None:
        _write(above, logs, config, settings, output)
        if not quiet:
            console.say(str(output))


def _solved(  # see `calibrate`
    logs: Sequence[Path],
    config: str | None,
    settings: Sequence[str],
    keep: Sequence[str],
    output: Path | None,
    json: Path | None,
    quiet: bool,
) -> Written:
    """Calibrate by all motions; show it, draw it, and return what is to be written."""
    from impslam.calibration.calibrate import calibrate as solve
    from impslam.calibration.calibrate import config_tables

    chosen, drives = _read(logs, config, settings, quiet)
    found = solve(chosen, drives, keep)
    if not quiet:
        _show(found, keep)
    if json is not None:
        json.write_text(json_text.dumps(_numbers(found), indent=1) + "\n", "utf-8")
    if output is not None:
        from impslam.calibration.picture import write_picture

        output.parent.mkdir(parents=True, exist_ok=True)
        names = ", ".join(log.name for log in logs)
        write_picture(found, output.with_suffix(".png"), f"Calibration from {names}")
    told = [
        f"{one.name}: +- {one.sigma:.2g} {one.unit}" for one in found.parameters if one.observable
    ]
    return chosen, config_tables(found), told


def _read(
    logs: Sequence[Path], base: str | None, settings: Sequence[str], quiet: bool
) -> tuple[Config, list[Drive]]:
    """Return the config, as it fits the first log, and the drives of all."""
    from impslam.calibration.calibrate import extract_drives
    from impslam.calibration.recording import record
    from impslam.open_log import open_log

    configs, drives = list[Any](), list[Any]()
    with display(quiet) as shown:
        for log in logs:
            config, source = open_log(log, base, settings)
            task = shown and shown.add_task(log.name, total=source.total)

            def tick(source: Any = source, task: Any = task) -> None:
                if shown:
                    shown.update(task, completed=source.position)

            drives += extract_drives(config, record(config, source, tick), str(log))
            configs.append(config)
    names = {drive.model.names for drive in drives}
    if len(names) > 1:
        raise ConfigError(
            f"{logs[0]} and others have other kinds of odometry; calibrate one at a time"
        )
    return configs[0], drives


def _show(found: Calibration, keep: Sequence[str]) -> None:
    """Print parameters and noise."""
    motions = sum(len(kept) for kept in found.solution.kept)
    fit = sum(int(kept.sum()) for kept in found.solution.kept)
    console.say(f"{fit} of {motions} motions of the lidar fit")
    if fit < SLIPS * motions:
        console.say(
            "the others do not: wheels slip, or stamps jitter; what you have measured is better kept, "
            "e.g. --keep x --keep y --keep yaw --keep latency"
        )
    header = ("parameter", "unit", "observable", "config", "found", "std")
    console.show_table(header, list(_rows(found, keep)), numbers=3)
    noise = [(s.name, s.unit, *_rounded(s.sigma, s.value, s.sigma)) for s in found.random_errors]
    console.show_table(("random error", "unit", "found", "std"), noise, numbers=2)
    for gyro in {drive.gyro for drive in found.drives if drive.gyro is not None}:
        bias = " +- ".join(_rounded(gyro.bias_sigma, gyro.bias, gyro.bias_sigma))
        scale = " +- ".join(_rounded(gyro.scale_sigma, gyro.scale, gyro.scale_sigma))
        console.say(f"gyro: bias {bias} rad/s, true over measured rate {scale}")


def _rows(found: Calibration, keep: Sequence[str]) -> Iterator[tuple[str, ...]]:
    from impslam.calibration.order_clock import MAX_DISORDER

    back = max(drive.disorder for drive in found.drives)
    advice = (
        ADVICE
        if back <= MAX_DISORDER
        else {**ADVICE, "latency": f"stamps run back by {back:.2f} s"}
    )
    for one in found.parameters:
        if one.observable:
            yield one.name, one.unit, "yes", *_rounded(one.sigma, one.before, one.value, one.sigma)
        else:
            why = "kept" if one.name in keep else f"no: {advice.get(one.name, 'drive more')}"
            yield one.name, one.unit, why, f"{one.before:g}", "", ""


def _rounded(sigma: float, *values: float) -> tuple[str, ...]:
    """Return values with two digits of their standard deviation."""
    import math

    digits = 6 if not 0.0 < sigma < math.inf else max(0, 1 - math.floor(math.log10(sigma)))
    return tuple(f"{value:.{digits}f}" for value in values)


def _base(log: Path, config: str | None) -> str | None:
    """Return what the written config is based on; None if it must be whole."""
    from impslam.config import presets
    from impslam.sources.base import recognise

    if config is not None:
        return config if config in presets() else str(Path(config).resolve())
    with recognise(log)(path=log) as source:
        return source.preset if source.preset in presets() else None


def _write(
    above: Written, logs: Sequence[Path], base: str | None, settings: Sequence[str], output: Path
) -> None:
    """Write the config, on top of the one that it began with."""
    import tomli_w

    from impslam.config import load, merge, parse_setting

    config, found, told = above
    name = _base(logs[0], base)
    below: dict[str, Any] = config.resolved() if name is None else {"base": name}
    for setting in settings:
        below = merge(below, parse_setting(setting))
    lines = "".join(f"# {line}\n" for line in told)
    names = ", ".join(log.name for log in logs)
    output.parent.mkdir(parents=True, exist_ok=True)
    text = tomli_w.dumps(merge(below, found))
    output.write_text(f"# Calibrated from {names}\n{lines}{text}", "utf-8")
    load(output)


def _numbers(found: Calibration) -> dict[str, Any]:
    from impslam.calibration.calibrate import config_tables
    from impslam.evaluation.json_values import json_values

    numbers: dict[str, Any] = json_values({
        "parameters": found.parameters,
        "covariance": found.covariance.tolist(),
        "random_errors": found.random_errors,
        "gyro": [drive.gyro for drive in found.drives],
        "motions": [len(kept) for kept in found.solution.kept],
        "motions_that_fit": [int(kept.sum()) for kept in found.solution.kept],
        "config": config_tables(found),
    })  # fmt: skip
    return numbers
