"""Calibrated parameters and noise as tables on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from impslam.cli import console

if TYPE_CHECKING:
    from impslam.calibration.calibrate import Calibration

MIN_FITTING_SHARE = 0.9
"""Share of motions that fit at least if the wheels hardly slip."""
ADVICE = {
    "x": "drive turns to both sides",
    "y": "drive turns to both sides",
    "yaw": "drive straight stretches",
    "track": "drive turns to both sides",
    "turn_scale": "drive turns to both sides",
    "latency": "change speed and turn rate often",
    "range_offset": "pass walls at an angle",
}
"""How to make each parameter observable."""


def show_calibration(found: Calibration, keep: Sequence[str]) -> None:
    """Print the parameters and the noise of a calibration; `keep` are the parameters kept by the user."""
    motions = sum(len(kept) for kept in found.solution.kept)
    fit = sum(int(kept.sum()) for kept in found.solution.kept)
    console.echo(f"{fit} of {motions} lidar motions fit")
    if fit < MIN_FITTING_SHARE * motions:
        console.echo(
            "the others do not: wheels slip, or stamps jitter; keep the parameters that you have "
            "measured, e.g. --keep x --keep y --keep yaw --keep latency"
        )
    header = ("parameter", "unit", "observable", "config", "found", "std")
    console.show_table(header, list(_rows(found, keep)), numbers=3)
    noise = [(s.name, s.unit, *_rounded(s.sigma, s.value, s.sigma)) for s in found.random_errors]
    console.show_table(("random error", "unit", "found", "std"), noise, numbers=2)
    for gyro in {drive.gyro for drive in found.drives if drive.gyro is not None}:
        bias = " ± ".join(_rounded(gyro.bias_sigma, gyro.bias, gyro.bias_sigma))
        scale = " ± ".join(_rounded(gyro.scale_sigma, gyro.scale, gyro.scale_sigma))
        console.echo(f"gyro: bias {bias} rad/s, true / measured rate {scale}")


def _rows(found: Calibration, keep: Sequence[str]) -> Iterator[tuple[str, ...]]:
    from impslam.calibration.calibrate import LENGTHS
    from impslam.calibration.order_clock import MAX_DISORDER

    lengths = (f"--keep {one.name}" for one in found.parameters if one.name in LENGTHS)
    back = max(drive.disorder for drive in found.drives)
    scale = f"not separable from the robot's lengths: {' or '.join(lengths)}"
    advice = {**ADVICE, "range_scale": scale}
    if back > MAX_DISORDER:
        advice["latency"] = f"stamps run back by {back:.2f} s"
    for one in found.parameters:
        if one.observable:
            yield one.name, one.unit, "yes", *_rounded(one.sigma, one.before, one.value, one.sigma)
        else:
            why = "kept" if one.name in keep else f"no: {advice.get(one.name, 'drive more')}"
            yield one.name, one.unit, why, f"{one.before:g}", "", ""


def _rounded(sigma: float, *values: float) -> tuple[str, ...]:
    """Return values rounded to two digits of their standard deviation."""
    digits = 6 if not 0.0 < sigma < math.inf else max(0, 1 - math.floor(math.log10(sigma)))
    return tuple(f"{value:.{digits}f}" for value in values)
