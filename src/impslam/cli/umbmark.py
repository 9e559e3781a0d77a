"""`imp calibrate --square`: wheels and track from squares, after Borenstein and Feng."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impslam.cli import console
from impslam.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from impslam.calibration.umbmark import Square, Umbmark
    from impslam.config import Config


def show_squares(
    logs: Sequence[Path],
    base: str | None,
    settings: Sequence[str],
    side: float,
    json: Path | None,
    quiet: bool,
) -> tuple[Config, dict[str, Any], list[str]]:
    """Calibrate from squares; print the result, write it to `json`, and return it, as `calibrate.Result`.

    Raises
    ------
    ConfigError
        If the squares do not turn both ways, or the robot has no wheel encoders.
    SourceError
        If a log does not end where it began.
    """
    from impslam.calibration.umbmark import corrected, umbmark
    from impslam.cli.output_files import write_json

    if not 0.0 < side < math.inf:
        raise ConfigError("--square is a length in m, greater than 0")
    config, squares, values = _read(logs, base, settings)
    left = np.array([one.error for one in squares if one.is_left])
    right = np.array([one.error for one in squares if not one.is_left])
    if not (len(left) and len(right)):
        raise ConfigError(
            f"--square: {len(left)} squares turn left and {len(right)} right; drive some of each"
        )
    found = umbmark(right, left, side, values[2])
    new = corrected(found, values)
    if not quiet:
        _show(found, squares, values, new)
    names = ("wheel_radius", "right_left_ratio", "track")
    table = {"odometry": dict(zip(names, new.tolist(), strict=True))}
    if json is not None:
        ends = [{"error_m": one.error.tolist(), "is_left": one.is_left} for one in squares]
        write_json(json, {"squares": ends, "umbmark": found, "config": table})
    return config, table, [f"UMBmark of {len(squares)} squares, {side:g} m"]


def _read(
    logs: Sequence[Path], base: str | None, settings: Sequence[str]
) -> tuple[Config, list[Square], np.ndarray[Any, np.dtype[np.float64]]]:
    from impslam.calibration.calibrate import extract_drives
    from impslam.calibration.recording import first_lidar, record
    from impslam.calibration.umbmark import measure_square
    from impslam.odometry.encoders import Encoders
    from impslam.open_log import open_log

    squares, configs = list["Square"](), list["Config"]()
    for log in logs:
        config, source = open_log(log, base, settings)
        odometry, (_, lidar) = config.make_robot().odometry, first_lidar(config)
        if not isinstance(odometry, Encoders):
            raise ConfigError("--square: needs wheel encoders; set odometry.kind=encoders")
        values = np.array([odometry.wheel_radius, odometry.right_left_ratio, odometry.track])
        recording = record(config, source)
        square = measure_square(
            lidar, recording, extract_drives(config, recording, str(log))[0], values
        )
        if square is None:
            raise SourceError(
                f"{log}: the last scan does not match the first; end the drive where it began"
            )
        squares.append(square)
        configs.append(config)
    return configs[0], squares, values


def _show(found: Umbmark, squares: Sequence[Square], values: Any, new: Any) -> None:
    rows = [
        (str(k + 1), "left" if one.is_left else "right", *(f"{1000 * e:.1f}" for e in one.error))
        for k, one in enumerate(squares)
    ]
    console.show_table(("square", "turns", "x, mm", "y, mm"), rows, numbers=2)
    console.echo("return: true minus odometry, x along the first side\n")
    console.show_facts(
        {
            "E_max,syst": f"{1000 * found.error:.1f} mm",
            "E_d (right / left diameter)": f"{found.diameters:.5f}",
            "E_b (true / current track)": f"{found.track:.5f}",
            "wheel_radius": f"{values[0]:.5f} -> {new[0]:.5f} m",
            "right_left_ratio": f"{values[1]:.5f} -> {new[1]:.5f}",
            "track": f"{values[2]:.4f} -> {new[2]:.4f} m",
        }
    )
