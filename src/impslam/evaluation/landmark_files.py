"""True landmarks as a table: `LOG.landmarks.csv` of a simulation, `truth.landmarks.csv` of a run.

A surveyed list needs only `x,y`, or `x1,y1,x2,y2` for walls; missing names and kinds get defaults.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.landmarks import true_wall
from impslam.paths import read_text
from impslam.types import Array, TrueLandmark

TRUE_LANDMARKS = "truth.landmarks.csv"
"""The true landmarks in a run folder, if the log has them, in the log's own frame."""
COLUMNS = ("name", "kind", "x", "y", "r", "alpha", "radius", "x1", "y1", "x2", "y2")
"""x, y: the centre, or the foot of the normal from the origin (m). r (m), alpha (rad) of walls, radius
(m) of cylinders, x1 to y2: end points of walls (m). Cells that do not apply to a kind are empty."""
ENDS = ("x1", "y1", "x2", "y2")


def landmarks_path(log: Path) -> Path:
    """Return the path of the true landmarks of a log, LOG.landmarks.csv beside it."""
    return log.with_name(f"{log.stem}.landmarks.csv")


def read_surveyed(log: Path) -> list[TrueLandmark]:
    """Return the true landmarks from the file beside a log; empty if there is none."""
    path = landmarks_path(log)
    return read_true_landmarks(path) if path.is_file() else []


def write_true_landmarks(path: Path, landmarks: Iterable[TrueLandmark]) -> None:
    """Write a row for each true landmark; see `COLUMNS`."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for landmark in landmarks:
            cells = {"name": landmark.name, "kind": landmark.kind, **landmark.parameters}
            cells["x"], cells["y"] = map(float, landmark.position)
            if landmark.end_points is not None:
                ends = map(float, landmark.end_points.ravel())
                cells |= dict(zip(ENDS, ends, strict=True))
            rows.writerow(cells.get(name, "") for name in COLUMNS)


def read_true_landmarks(path: Path) -> list[TrueLandmark]:
    """Read true landmarks. The default name is the row number, the default kind is point.

    A table with all `COLUMNS` may be empty: a simulation writes it of a world without landmarks.

    Raises
    ------
    ImpError
        If the file is missing or empty, or a row is not a landmark.
    """
    text = read_text(path, "check the path").removeprefix("\ufeff")  # the BOM of spreadsheets
    try:
        table = csv.DictReader(io.StringIO(text), strict=True)
        rows, columns = list(table), tuple(table.fieldnames or ())
    except csv.Error as error:
        raise ImpError(f"{path}: cannot be read as a table ({error}); check the path") from None
    if not rows and columns != COLUMNS:
        raise ImpError(f"{path}: contains no landmark; it needs the columns {','.join(COLUMNS)}")
    landmarks = [_landmark(row, number, path) for number, row in enumerate(rows, 1)]
    twice = [name for name, n in Counter(mark.name for mark in landmarks).items() if n > 1]
    if twice:
        raise ImpError(f"{path}: two landmarks are called {twice[0]!r}; rename one")
    return landmarks


def _landmark(row: Mapping[str, str | None], number: int, path: Path) -> TrueLandmark:
    cells = {name: cell for name, cell in row.items() if isinstance(cell, str) and cell.strip()}
    name = cells.pop("name", str(number))
    kind = cells.pop("kind", "wall" if "x1" in cells else "point")
    try:
        values = {name: _number(cell) for name, cell in cells.items() if name in COLUMNS}
        if kind == "wall" or "x1" in values:
            return _wall(name, np.array([values[end] for end in ENDS]).reshape(2, 2), kind)
        return TrueLandmark(name, kind, np.array([values["x"], values["y"]]), values)
    except KeyError as error:
        why = f"{error.args[0]} is missing"
    except ValueError as error:
        why = str(error)
    raise ImpError(f"{path}, landmark {number}: {why}; expected the columns {','.join(COLUMNS)}")


def _wall(name: str, ends: Array, kind: str) -> TrueLandmark:
    if np.array_equal(*ends):
        raise ValueError("its end points coincide")
    return true_wall(name, ends, kind)


def _number(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell} is not finite")
    return value
