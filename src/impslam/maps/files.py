"""The files of a map: the grid as map_server reads it, and the landmarks as a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from impslam.errors import ImpError
from impslam.maps.grid import OccupancyGrid
from impslam.types import Array, Landmark

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
"""Grey values of a trinary map."""
FREE_BELOW, OCCUPIED_ABOVE = 0.196, 0.65
"""map_server's thresholds; 0.196 and not 0.25, or the grey of unknown cells reloads as free."""

COLUMNS = (
    *("id", "kind", "x", "y", "radius", "r", "alpha", "cov_11", "cov_12", "cov_22"),
    *("x1", "y1", "x2", "y2", "observations", "first_stamp", "last_stamp"),
)
"""Columns of landmarks.csv, in this order; cells that do not apply to a kind are empty.

x, y: the centre, or the foot of the normal from the map's origin (m). radius (m) of cylinders; r (m)
and alpha (rad) of walls. cov_..: covariance of x, y of points, of r, alpha of walls. x1 to y2: end
points of walls (m). Parameters of other kinds follow in further columns, in alphabetical order.
"""


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """A trinary map: `pixels` (rows, columns) uint8 with row 0 at the top, as in the file.

    `resolution` is in m, `origin` (2,) the lower-left corner in map, m.
    """

    pixels: npt.NDArray[np.uint8]
    resolution: float
    origin: Array

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top in map, m."""
        rows, columns = self.pixels.shape
        x, y = map(float, self.origin)
        return x, x + columns * self.resolution, y, y + rows * self.resolution


def map_image(grid: OccupancyGrid) -> MapImage:
    """Return the grid in three greys, cut to what is known."""
    free, occupied = (math.log(p / (1.0 - p)) for p in (FREE_BELOW, OCCUPIED_ABOVE))
    pixels = np.full(grid.logodds.shape, UNKNOWN, np.uint8)
    pixels[grid.logodds < free] = FREE
    pixels[grid.logodds > occupied] = OCCUPIED
    rows, columns = (np.flatnonzero((grid.logodds != 0.0).any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        nothing = np.full((1, 1), UNKNOWN, np.uint8)
        return MapImage(nothing, grid.resolution, np.zeros(2))
    top, left = rows[0], columns[0]
    pixels = pixels[top : rows[-1] + 1, left : columns[-1] + 1]
    origin = (grid.corner + np.array([left, top])) * grid.resolution
    return MapImage(pixels[::-1].copy(), grid.resolution, origin)


def write_map(folder: Path, image: MapImage) -> None:
    """Write map.pgm and map.yaml."""
    rows, columns = image.pixels.shape
    header = f"P5\n{columns} {rows}\n255\n".encode()
    (folder / "map.pgm").write_bytes(header + image.pixels.tobytes())
    x, y = image.origin
    text = (
        f"image: map.pgm\nmode: trinary\nresolution: {image.resolution:.6g}\n"
        f"origin: [{x:.6f}, {y:.6f}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_ABOVE}\nfree_thresh: {FREE_BELOW}\n"
    )
    (folder / "map.yaml").write_text(text)


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
