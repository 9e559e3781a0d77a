"""The landmarks of a map as a table: landmarks.csv."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.types import Landmark

COLUMNS = (
    *("id", "kind", "x", "y", "radius", "r", "alpha", "cov_11", "cov_12", "cov_22"),
    *("x1", "y1", "x2", "y2", "observations", "first_stamp", "last_stamp"),
)
"""Columns of landmarks.csv, in this order; cells that do not apply to a kind are empty.

x, y: the centre, or the foot of the normal from the map's origin (m). radius (m) of cylinders; r (m)
and alpha (rad) of walls. cov_..: covariance of x, y of points, of r, alpha of walls. x1 to y2: end
points of walls (m). Parameters of other kinds follow in further columns, in alphabetical order.
"""


def write_landmarks(path: Path, landmarks: Iterable[Landmark]) -> None:
    """Write landmarks.csv; see `COLUMNS`."""
    landmarks = list(landmarks)
    more = sorted({name for mark in landmarks for name in mark.parameters} - set(COLUMNS))
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, [*COLUMNS, *more], restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(_row(mark) for mark in landmarks)


def _row(mark: Landmark) -> dict[str, str]:
    ends = () if mark.end_points is None else np.ravel(mark.end_points)
    numbers = {
        **{name: value for name, value in mark.parameters.items() if name not in ("x", "y")},
        **dict(zip(("x", "y"), mark.position, strict=True)),
        **dict(zip(("x1", "y1", "x2", "y2"), ends, strict=False)),
    }
    cells = {name: f"{value:.9f}" for name, value in numbers.items()}
    for name, (i, j) in {"cov_11": (0, 0), "cov_12": (0, 1), "cov_22": (1, 1)}.items():
        cells[name] = f"{mark.covariance[i, j]:.9e}"
    stamps = {"first_stamp": f"{mark.first_stamp:.9f}", "last_stamp": f"{mark.last_stamp:.9f}"}
    plain = {"id": str(mark.id), "kind": mark.kind, "observations": str(mark.observations)}
    return {**cells, **stamps, **plain}


def read_landmarks(path: Path) -> list[Landmark]:
    """Read landmarks.csv.

    Raises
    ------
    ImpError
        If the file is missing or a row is not one of `write_landmarks`.
    """
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImpError(f"{path}: cannot be read as a table ({error}); check the path") from None
    return [_landmark(row, f"{path}, line {number}") for number, row in enumerate(rows, 2)]


def _landmark(row: Mapping[str, str], where: str) -> Landmark:
    known = {"id", "kind", "cov_11", "cov_12", "cov_22", "x1", "y1", "x2", "y2"}
    known |= {"x", "y", "observations", "first_stamp", "last_stamp"}
    try:
        ends = [float(row[name]) for name in ("x1", "y1", "x2", "y2") if row[name]]
        a, b, c = (float(row[name]) for name in ("cov_11", "cov_12", "cov_22"))
        return Landmark(
            int(row["id"]),
            row["kind"],
            np.array([float(row["x"]), float(row["y"])]),
            {name: float(cell) for name, cell in row.items() if name not in known and cell},
            np.array([[a, b], [b, c]]),
            np.reshape(ends, (2, 2)) if ends else None,
            int(row["observations"]),
            float(row["first_stamp"]),
            float(row["last_stamp"]),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise ImpError(
            f"{where}: not a landmark ({error}); see the docs of landmarks.csv"
        ) from None
