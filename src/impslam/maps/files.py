"""The grid of a map in map_server's format: map.pgm and map.yaml."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from impslam.maps.grid import OccupancyGrid
from impslam.types import Array

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
"""Grey values of a trinary map."""
FREE_BELOW, OCCUPIED_ABOVE = 0.196, 0.65
"""map_server's thresholds; with 0.25 instead of 0.196, the grey of unknown cells would reload as free."""


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
    """Return the grid in three greys, cropped to the known area.

    A cell is free once two scans have passed through it. One is enough if the robot has not moved: there is
    no view from elsewhere to wait for, and a map without free cells is of no use for planning.
    """
    free, occupied = (math.log(p / (1.0 - p)) for p in (FREE_BELOW, OCCUPIED_ABOVE))
    if grid.is_stationary:
        free = 0.0
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
