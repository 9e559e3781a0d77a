"""Trajectories as files of the TUM RGB-D benchmark: `stamp x y z qx qy qz qw`, metres, seconds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.types import Array


def tum_row(stamp: float, pose: Array) -> str:
    """Return the line of a planar pose; nanoseconds and nanometres, so nothing is lost."""
    half = 0.5 * pose[2]
    turn = f"{math.sin(half):.12f} {math.cos(half):.12f}"
    return f"{stamp:.9f} {pose[0]:.9f} {pose[1]:.9f} 0 0 0 {turn}\n"


def write_tum(path: Path, trajectory: Array) -> None:
    """Write rows (n, 4) of stamp, x, y, theta."""
    path.write_text("".join(tum_row(row[0], row[1:]) for row in trajectory))


def read_tum(path: Path) -> Array:
    """Return rows (n, 4) of stamp, x, y, yaw in the order of the file.

    Raises
    ------
    ImpError
        If the file is missing, holds no pose, or a line is not one.
    """
    rows = np.array(list(read_numbers(path, 8, "stamp x y z qx qy qz qw"))).reshape(-1, 8)
    x, y, z, w = rows[:, 4:].T
    if len(rows) == 0:
        raise ImpError(f"{path}: holds no pose; a trajectory needs rows of stamp x y z qx qy qz qw")
    if bad := np.flatnonzero(np.hypot(z, w) + np.hypot(x, y) < 0.5).tolist():
        raise ImpError(f"{path}: the quaternion of row {bad[0] + 1} is not of length 1; correct it")
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack((rows[:, :3], yaw))


def read_numbers(path: Path, columns: int, names: str) -> Iterator[list[float]]:
    """Yield the rows of a text file of numbers; '#' begins a comment.

    Raises
    ------
    ImpError
        If the file cannot be read, or a row has not `columns` finite numbers.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImpError(f"{path}: cannot be read as text ({error}); check the path") from None
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if words:
            yield _numbers(words, columns, f"{path}, line {number}: expected {names}")


def _numbers(words: list[str], columns: int, expected: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ImpError(f"{expected}; {error}") from None
    if len(values) != columns:
        raise ImpError(f"{expected}; found {len(values)} numbers")
    if not all(map(math.isfinite, values)):
        raise ImpError(f"{expected}; found a number that is not finite")
    return values
