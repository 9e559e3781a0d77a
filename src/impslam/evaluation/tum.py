"""Trajectories as files of the TUM RGB-D benchmark: `stamp x y z qx qy qz qw`, metres, seconds.

An unknown heading (GPS, some trackers) is NaN, and in files the quaternion `0 0 0 0`, which is not a
rotation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.paths import read_text
from impslam.types import Array

TRUTH = "truth.tum"
"""The true path in a run folder, if the log has it, in the log's own frame."""
PATH_COLUMNS = "stamp,x,y,theta,xx,xy,xt,yy,yt,tt"
"""Columns of trajectory.csv: m, rad, s; xx to tt are the pose covariance's distinct entries."""
HEALTH_COLUMN = "health"
"""Optional last column: 0 TRACKING, 1 DEGRADED, 2 LOST."""


_ROW = "%.9f %.9f %.9f 0 0 0 %.12f %.12f\n"


def tum_rows(stamps: Array, poses: Array) -> str:
    """Return the lines of planar poses (n, 3) at stamps (n,), s.

    The resolution is nanoseconds and nanometres.
    """
    half = 0.5 * poses[:, 2]
    columns = np.column_stack((stamps, poses[:, :2], np.sin(half), np.cos(half)))
    if np.isfinite(half).all():
        return _ROW * len(columns) % tuple(columns.ravel().tolist())
    rows = (_ROW % tuple(row) for row in columns.tolist())
    return "".join(row.replace("nan nan", "0 0") for row in rows)


def write_tum(path: Path, trajectory: Array) -> None:
    """Write rows (n, 4) of stamp, x, y, theta."""
    with path.open("w", encoding="utf-8") as stream:
        for begin in range(0, len(trajectory), 1000):  # text needs three times the memory
            rows = trajectory[begin : begin + 1000]
            stream.write(tum_rows(rows[:, 0], rows[:, 1:]))


def read_tum(path: Path, advice: str = "give a TUM file") -> Array:
    """Return rows (n, 4) of stamp, x, y, yaw in the order of the file.

    The yaw is NaN if the quaternion is zero or not finite. `advice` is for a file that is not text.

    Raises
    ------
    ImpError
        If the file is missing, contains no pose, or a line is not a pose.
    """
    names = "stamp x y z qx qy qz qw"
    rows = np.array(list(read_numbers(path, 8, names, finite=4, advice=advice))).reshape(-1, 8)
    if len(rows) == 0:
        raise ImpError(f"{path}: contains no pose; a trajectory needs rows of {names}")
    return np.column_stack((rows[:, :3], _yaw(rows[:, 4:], path)))


def _yaw(quaternions: Array, path: Path) -> Array:
    """Return the yaw (n,) of quaternions (n, 4) x y z w."""
    length = np.sqrt(np.sum(quaternions**2, axis=1))
    known = np.isfinite(length) & (length > 0.0)
    if bad := np.flatnonzero(known & ~np.isclose(length, 1.0, atol=0.1)).tolist():
        raise ImpError(f"{path}: the quaternion of row {bad[0] + 1} is not of length 1; correct it")
    yaw = np.full(len(quaternions), np.nan)
    x, y, z, w = quaternions[known].T
    yaw[known] = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return yaw


def read_numbers(
    path: Path,
    columns: int,
    names: str,
    *,
    head: str = "",
    finite: int | None = None,
    advice: str = "check the path",
) -> Iterator[list[float]]:
    """Yield the rows of a text file of numbers; '#' begins a comment.

    `head` is the required first line of the file, if any; the first `finite` numbers of a row, by default
    all, must be finite. `advice` is for a file that cannot be read.

    Raises
    ------
    ImpError
        If the file cannot be read, or a row does not have `columns` such numbers.
    """
    lines = read_text(path, advice).removeprefix("\ufeff").splitlines()  # the BOM of Windows
    if head and lines[:1] != [head]:
        raise ImpError(f"{path}: does not begin with {head!r}; write it again with `imp run`")
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if words and not (head and number == 1):
            expected = f"{path}, line {number}: expected {names}"
            yield _numbers(words, columns, expected, finite)


def _numbers(words: list[str], columns: int, expected: str, finite: int | None) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ImpError(f"{expected}; {error}") from None
    if len(values) != columns:
        raise ImpError(f"{expected}; found {len(values)} numbers")
    if not all(map(math.isfinite, values[:finite])):
        raise ImpError(f"{expected}; found a number that is not finite")
    return values
