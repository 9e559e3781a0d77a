"""`imp calibrate`: wheels, lidar pose and latency of a robot, from logs in which it turns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from impslam.cli import console
from impslam.cli.calibration_table import show_calibration
from impslam.cli.console import Columns, Common, ConfigName, Output, Repeatable, Settings, Topics
from impslam.cli.progress import display
from impslam.errors import ConfigError

Result: TypeAlias = "tuple[Config, dict[str, Any], list[str]]"
"""The initial config, the calibrated values to merge into it, and comments on their uncertainty."""

if TYPE_CHECKING:
    from impslam.calibration.calibrate import Calibration
    from impslam.calibration.residuals import CalibrationDrive
    from impslam.config import Config


def calibrate(  # noqa: PLR0913  # each is an option that a user may give
    *logs: Path,
    config: ConfigName = None,
    settings: Settings = (),
    topics: Topics = (),
    columns: Columns = (),
    keep: Repeatable = (),
    square: float | None = None,
    output: Output = None,
    json: Path | None = None,
    common: Common | None = None,
) -> None:
    """Calibrate a robot's wheels, lidar pose, latency and noise from logs in which it turns.

    The lidar's motion, estimated from its scans alone, is compared with odometry. Each parameter is
    printed with its standard deviation. Parameters that the drives do not make observable are kept.

    Parameters
    ----------
    logs
        Logs of one robot with the same wheels and mounts.
    keep
        A parameter to leave unchanged. To calibrate the range scale, keep wheel_radius or track.
    square
        Use the UMBmark method: each log is a square with this side length (m) that ends where it
        began, some turning left and some right. Only wheels and track are calibrated.
    output
        TOML file for the calibrated config; a PNG picture of before and after is written beside it,
        except with --square.
    json
        JSON file to write all numbers to.
    """
    from impslam.cli.job import all_settings
    from impslam.paths import keep_inputs

    if not logs:
        raise ConfigError("no log given; name one or more logs of one robot")
    if output is not None and output.suffix.lower() != ".toml":
        raise ConfigError(f"{output}: the config is written as TOML; give -o NAME.toml")
    written = () if output is None else (output, output.with_suffix(".png"))
    keep_inputs([*logs, *([] if config is None else [Path(config)])], [*written, json])
    if square is not None and keep:
        raise ConfigError("--keep cannot be combined with --square; leave out one of them")
    changes = all_settings(settings, topics, columns)
    quiet = common is not None and common.quiet
    if square is not None:
        from impslam.cli.umbmark import show_squares

        result = show_squares(logs, config, changes, square, json, quiet)
    else:
        result = _calibrate(logs, config, changes, keep, output, json, quiet)
    if output is not None:
        _write(result, logs, config, changes, output)
        if not quiet:
            console.echo(str(output))


def _calibrate(  # see `calibrate`
    logs: Sequence[Path],
    config: str | None,
    settings: Sequence[str],
    keep: Sequence[str],
    output: Path | None,
    json: Path | None,
    quiet: bool,
) -> Result:
    """Calibrate with all motions, show and draw the result, and return it."""
    from impslam.calibration.calibrate import calibrate as solve
    from impslam.calibration.calibrate import config_tables
    from impslam.cli.output_files import write_json
    from impslam.paths import write_bytes

    chosen, drives = _read(logs, config, settings, quiet)
    found = solve(chosen, drives, keep)
    if not quiet:
        show_calibration(found, keep)
    if json is not None:
        write_json(json, _numbers(found))
    if output is not None:
        from impslam.calibration.picture import calibration_png

        output.parent.mkdir(parents=True, exist_ok=True)
        names = ", ".join(log.name for log in logs)
        picture = calibration_png(found, f"Calibration from {names}")
        write_bytes(output.with_suffix(".png"), picture)
    comments = [
        f"{one.name}: ± {one.sigma:.2g} {one.unit}".removesuffix(" 1")
        for one in found.parameters
        if one.observable
    ]
    return chosen, config_tables(found), comments


def _read(
    logs: Sequence[Path], base: str | None, settings: Sequence[str], quiet: bool
) -> tuple[Config, list[CalibrationDrive]]:
    """Return the config that fits the first log, and the drives of all logs."""
    from impslam.calibration.calibrate import extract_drives
    from impslam.calibration.recording import record
    from impslam.open_log import open_log

    configs, drives = list[Any](), list[Any]()
    with display(quiet) as progress:
        for log in logs:
            config, source = open_log(log, base, settings)
            task = progress and progress.add_task(log.name, total=source.total)

            def tick(source: Any = source, task: Any = task) -> None:
                if progress:
                    progress.update(task, completed=source.position)

            drives += extract_drives(config, record(config, source, tick), str(log))
            configs.append(config)
    names = {drive.model.names for drive in drives}
    if len(names) > 1:
        raise ConfigError(
            f"{logs[0]} and others have different kinds of odometry; calibrate each kind separately"
        )
    return configs[0], drives


def _base(log: Path, config: str | None, output: Path) -> str | None:
    """Return the base of the written config; None if it must contain all parameters."""
    from impslam.config import presets
    from impslam.paths import portable
    from impslam.sources.base import recognise

    if config is not None:
        return config if config in presets() else portable(Path(config), output.parent)
    with recognise(log)(path=log) as source:
        return source.preset if source.preset in presets() else None


def _write(
    result: Result, logs: Sequence[Path], base: str | None, settings: Sequence[str], output: Path
) -> None:
    """Write the calibrated config, based on the initial one."""
    import tomli_w

    from impslam.config import load, merge
    from impslam.paths import write_bytes
    from impslam.settings import parse_setting

    config, found, comments = result
    name = _base(logs[0], base, output)
    initial: dict[str, Any] = config.resolved() if name is None else {"base": name}
    for setting in settings:
        initial = merge(initial, parse_setting(setting))
    # The log may have chosen another kind of odometry than the base.
    initial = merge(initial, {"odometry": {"kind": config.odometry["kind"]}})
    lines = "".join(f"# {line}\n" for line in comments)
    names = ", ".join(log.name for log in logs)
    output.parent.mkdir(parents=True, exist_ok=True)
    text = tomli_w.dumps(merge(initial, found))
    write_bytes(output, f"# Calibrated from {names}\n{lines}{text}".encode())
    load(output)  # raises if the config is not valid


def _numbers(found: Calibration) -> dict[str, Any]:
    from impslam.calibration.calibrate import config_tables

    return {
        "parameters": found.parameters,
        "covariance": found.covariance.tolist(),
        "random_errors": found.random_errors,
        "gyro": [drive.gyro for drive in found.drives],
        "motions": [len(kept) for kept in found.solution.kept],
        "motions_that_fit": [int(kept.sum()) for kept in found.solution.kept],
        "config": config_tables(found),
    }
