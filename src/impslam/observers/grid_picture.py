"""The occupancy grid as a picture that a browser lays over a map."""

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
"""Blue, green, red and opacity for each grey of a trinary map; what nobody has seen is clear."""
COLOURS[FREE] = 255, 255, 255, 255
COLOURS[OCCUPIED] = 0x4D, 0x42, 0x37, 255


@dataclass(frozen=True, slots=True, eq=False)
class GridPicture:
    """The occupancy grid as a PNG with row 0 at the top; what nobody has seen is transparent.

    Attributes
    ----------
    png : the file's bytes
    version : counts up with each new picture, over all maps of a view
    origin : (2,) m in map, the lower-left corner of the picture
    resolution : m, side of a pixel
    size : columns and rows
    """

    png: bytes
    version: int
    origin: Array
    resolution: float
    size: tuple[int, int]


def paint(grid: OccupancyGrid, version: int) -> GridPicture:
    """Return a grid's picture, cut to what is known; the same greys as map.pgm."""
    image = map_image(grid)
    rows, columns = image.pixels.shape
    data = png(COLOURS[image.pixels])
    return GridPicture(data, version, image.origin, image.resolution, (columns, rows))


def occupancy(image: MapImage) -> npt.NDArray[np.int8]:
    """Return the cells as nav_msgs/OccupancyGrid has them: 0 free, 100 occupied, -1 unknown."""
    values = np.full(256, -1, np.int8)
    values[FREE], values[OCCUPIED] = 0, 100
    return np.asarray(values[image.pixels])


def coarsened(image: MapImage, most: int) -> MapImage:
    """Return a grid of so many cells at most; a coarser one is occupied where any of its cells is."""
    step = math.ceil(math.sqrt(image.pixels.size / most))
    if step <= 1:
        return image
    rows, columns = (math.ceil(side / step) for side in image.pixels.shape)
    cells = np.full((rows * step, columns * step), UNKNOWN, np.uint8)
    cells[: image.pixels.shape[0], : image.pixels.shape[1]] = image.pixels
    coarse = cells.reshape(rows, step, columns, step).min(axis=(1, 3))  # OCCUPIED < UNKNOWN < FREE
    left, _, _, top = image.extent
    resolution = step * image.resolution
    return MapImage(coarse, resolution, np.array([left, top - rows * resolution]))
