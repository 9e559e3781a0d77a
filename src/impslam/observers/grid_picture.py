"""The occupancy grid as a picture for a map in the browser."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from impslam.maps.files import FREE, OCCUPIED, UNKNOWN, MapImage, map_image
from impslam.maps.grid import OccupancyGrid
from impslam.observers.canvas import png
from impslam.types import Array

COLOURS: npt.NDArray[np.uint8] = np.zeros((256, 4), np.uint8)
"""Blue, green, red and opacity for each grey of a trinary map; unknown cells are transparent."""
COLOURS[FREE] = 255, 255, 255, 255
COLOURS[OCCUPIED] = 0x4D, 0x42, 0x37, 255


@dataclass(frozen=True, slots=True, eq=False)
class GridPicture:
    """The occupancy grid as a PNG with row 0 at the top; unknown cells are transparent.

    Attributes
    ----------
    png : the file's bytes
    version : number of the picture, counted over all maps of a view
    origin : (2,) lower-left corner of the picture in map, m
    resolution : side of a pixel, m
    size : columns and rows
    """

    png: bytes
    version: int
    origin: Array
    resolution: float
    size: tuple[int, int]


def paint(grid: OccupancyGrid, version: int) -> GridPicture:
    """Return a grid's picture, cropped to the known cells, in the greys of map.pgm."""
    image = map_image(grid)
    rows, columns = image.pixels.shape
    data = png(COLOURS[image.pixels])
    return GridPicture(data, version, image.origin, image.resolution, (columns, rows))


def occupancy(image: MapImage) -> npt.NDArray[np.int8]:
    """Return the cells with the values of nav_msgs/OccupancyGrid: 0 free, 100 occupied, -1 unknown."""
    values = np.full(256, -1, np.int8)
    values[FREE], values[OCCUPIED] = 0, 100
    return np.asarray(values[image.pixels])


def coarsened(image: MapImage, max_cells: int) -> MapImage:
    """Return a grid of at most `max_cells` cells; a coarse cell is occupied if any of its cells is."""
    step = math.ceil(math.sqrt(image.pixels.size / max_cells))
    if step <= 1:
        return image
    rows, columns = (math.ceil(side / step) for side in image.pixels.shape)
    cells = np.full((rows * step, columns * step), UNKNOWN, np.uint8)
    cells[: image.pixels.shape[0], : image.pixels.shape[1]] = image.pixels
    coarse = cells.reshape(rows, step, columns, step).min(axis=(1, 3))  # OCCUPIED < UNKNOWN < FREE
    left, _, _, top = image.extent
    resolution = step * image.resolution
    return MapImage(coarse, resolution, np.array([left, top - rows * resolution]))
