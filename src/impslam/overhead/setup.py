"""Setup of overhead tracking: a TOML file with measurements of the scene.

start = 1000.0                                   # stamp of the first picture, s
board = {columns = 10, rows = 7, square = 0.05, views = "board"}
marker = {id = 0, size = 0.1, height = 0.2}
discs = {colour = "#e86e28", height = 0.7, radii = [0.1524]}

[floor]
points = [{x = 0.0, y = 0.0, pixel = [311.0, 845.5]}, {x = 2.0, y = 0.0, marker = 10}, ...]
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

import cv2
from pydantic import ValidationError, model_validator

from impslam import toml
from impslam.component import explain
from impslam.errors import ConfigError
from impslam.parameters import Parameters, parameter
from impslam.paths import read_text

Dictionary = Literal[
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h11", "4X4_50", "5X5_100", "6X6_250", "ARUCO_ORIGINAL"
]  # fmt: skip
MARKER_SIGMA = 0.25  # px, of the middle of a marker on the floor


class Board(Parameters):
    """A board for the calibration of the lens, in views from many sides."""

    kind: Literal["chessboard", "charuco"] = parameter("chessboard", "", "what is printed on it")
    columns: int = parameter(10, "1", "squares across", ge=3, le=100)
    rows: int = parameter(7, "1", "squares down", ge=3, le=100)
    square: float = parameter(0.05, "m", "side of a square", gt=0.0)
    ratio: float = parameter(0.75, "1", "of a ChArUco marker to its square", gt=0.0, lt=1.0)
    dictionary: Dictionary = parameter("5X5_100", "", "of a ChArUco board's markers")
    views: str = parameter(..., "", "a video, or a folder of pictures, beside the setup file")


class FloorPoint(Parameters):
    """A point with a measured position, and its pixel or marker in the video."""

    x: float = parameter(..., "m", "in map")
    y: float = parameter(..., "m", "in map")
    z: float = parameter(0.0, "m", "above the floor")
    pixel: tuple[float, float] | None = parameter(None, "px", "where it is seen")
    marker: int | None = parameter(None, "1", "or the marker that it is the middle of", ge=0)

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.pixel is None) == (self.marker is None):
            raise ValueError("give either pixel or marker")
        return self


class Floor(Parameters):
    """Points that determine the camera's pose above the floor; their frame becomes map."""

    points: tuple[FloorPoint, ...] = parameter(..., "", "four or more, spread out", min_length=4)
    sigma: float = parameter(0.002, "m", "of a measured coordinate: a tape's", ge=0.0)
    pixel_sigma: float = parameter(0.5, "px", "of a pixel: picked by hand", gt=0.0)


class Marker(Parameters):
    """The marker on the robot, flat and facing up."""

    dictionary: Dictionary = parameter("APRILTAG_36h11", "", "also of the markers on the floor")
    id: int = parameter(0, "1", "number in the dictionary", ge=0)
    size: float = parameter(0.10, "m", "side of the black square", gt=0.0)
    height: float = parameter(0.20, "m", "above the floor", ge=0.0)
    height_sigma: float = parameter(0.002, "m", "of that", ge=0.0)
    mount: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "m, m, rad", "T_base_marker: x of the marker is its upper edge's direction"
    )


class Discs(Parameters):
    """Coloured discs on top of cylinders, located for the map's truth."""

    colour: str = parameter("#e86e28", "", "red, green, blue", pattern="^#[0-9a-fA-F]{6}$")
    tolerance: float = parameter(25.0, "1", "of the colour, in CIE Lab a and b", gt=0.0)
    height: float = parameter(0.7, "m", "above the floor", ge=0.0)
    radii: tuple[float, ...] = parameter(
        (0.1524,), "m", "that discs and cylinders have", min_length=1
    )


class Setup(Parameters):
    """The whole setup."""

    start: float = parameter(0.0, "s", "stamp of the first picture on the robot's clock")
    board: Board | None = None
    floor: Floor
    marker: Marker = Marker()
    discs: Discs | None = None


def load_setup(path: Path) -> Setup:
    """Read a setup file.

    Raises
    ------
    ConfigError
        If the file cannot be read or is invalid, with one line that names the file and the key.
    """
    text = read_text(path, "name the setup of the camera with --setup FILE", ConfigError)
    try:
        return Setup.model_validate(toml.parse(text, str(path)))
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error, '', Setup.model_fields)}") from None


def dictionary(name: Dictionary) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of markers."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
