"""The occupancy grid as a picture that a browser lays over a map."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from impslam.maps.files import FREE, OCCUPIED, map_image
from impslam.maps.grid import OccupancyGrid
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
    done, png = cv2.imencode(".png", COLOURS[image.pixels])
    assert done, "a PNG of any size can be encoded"
    return GridPicture(png.tobytes(), version, image.origin, image.resolution, (columns, rows))
