"""Maps of other programs, to localise in: a map_server grid becomes keyframes with scans of its walls.

Each keyframe is in free space, and its scan ends at the occupied cells around it, like that of a lidar.
Beams that reach an unknown cell or no cell are left out.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from impslam.errors import ImpError
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import compose
from impslam.map import Keyframes, Map
from impslam.maps.distances import distances
from impslam.maps.files import FREE_BELOW, OCCUPIED_ABOVE
from impslam.maps.layout import undriven
from impslam.types import Array

GRIDS = (".yaml", ".yml", ".pgm", ".png")
SPACING = 1.0  # m between keyframes: closer together they see the same walls
CLEARANCE = 0.2  # m, minimum distance of a keyframe from walls
MAX_RANGE, BEAMS = 20.0, 720  # m: other keyframes see farther walls; a beam every half degree
SIGMA = np.array([0.03, 0.03, 0.005])  # m, m, rad: limited by cells of 5 cm
FREE, UNKNOWN, OCCUPIED = range(3)
MAX_HEADER = 16_384  # bytes of a yaml file; those of map_server have 200
_FLAGS = dict.fromkeys(("true", "yes", "on", "y"), True) | dict.fromkeys(
    ("false", "no", "off", "n"), False
)
_NO_SCANS = "a pose graph has no scans to localise in; give the grid (map.yaml), or a map.imp"

Cells = npt.NDArray[np.uint8]


class ImportedGrid(NamedTuple):
    """Cells (rows, columns) from the lowest y on; `origin` (3,) is the pose of their corner in map."""

    cells: Cells
    resolution: float
    origin: Array


def load_map(path: Path) -> Map:
    """Return the map in a file of impslam, or of a map_server grid.

    Raises
    ------
    ImpError
        If it cannot be read, or is of another kind.
    """
    if path.suffix.lower() == ".g2o":
        raise ImpError(f"{path}: {_NO_SCANS}")
    if path.suffix.lower() in GRIDS:
        return grid_map(read_grid(path), path.name)
    return Map.load(path)


def read_grid(path: Path) -> ImportedGrid:
    """Return the grid of a map_server map, given its yaml file or the image beside it."""
    from ruamel.yaml.error import YAMLError  # noqa: PLC0415  # few runs read a grid

    yaml = path if path.suffix.lower() in {".yaml", ".yml"} else path.with_suffix(".yaml")
    try:
        header = _header(yaml)
        image = yaml.parent / _text(header, "image")  # absolute paths stay as they are
        return _grid(header, _darkness(image, negated=_flag(header, "negate")))
    except (OSError, ValueError, RecursionError, YAMLError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ImpError(
            f"{yaml}: not a map_server map ({reason}); give map.yaml and the image that it names"
        ) from None


def _header(path: Path) -> dict[str, Any]:
    """Return the table in a yaml file with all scalars as text, which the reader converts by their name."""
    from ruamel.yaml import YAML  # noqa: PLC0415  # few runs read a grid

    with path.open("rb") as stream:
        data = stream.read(MAX_HEADER + 1)
    if len(data) > MAX_HEADER:
        raise ValueError(f"it is longer than {MAX_HEADER} bytes")
    header = YAML(typ="base", pure=True).load(data)
    if not isinstance(header, dict):
        raise ValueError("it has no table of image, resolution and origin")  # noqa: TRY004
    return header


def _text(header: dict[str, Any], name: str, default: str | None = None) -> str:
    value = header.get(name, default)
    if not isinstance(value, str):
        raise ValueError(f"it has no {name}" if value is None else f"its {name} is not one value")  # noqa: TRY004
    return value


def _flag(header: dict[str, Any], name: str) -> bool:
    """Return a flag that is a number or a word, as in Nav2; False if it is missing."""
    word = _text(header, name, "0").lower()
    if word in _FLAGS:
        return _FLAGS[word]
    try:
        return int(word) != 0
    except ValueError:
        raise ValueError(f"its {name} is {word}, neither 0 nor 1") from None


def _darkness(image: Path, *, negated: bool) -> Array:
    """Return the darkness of each pixel, 0 to 1, with the lowest row first."""
    import cv2  # noqa: PLC0415  takes a tenth of a second

    if image.exists() and not image.is_file():  # a device may have no end
        raise ValueError(f"{image} is not a file")
    data = np.frombuffer(image.read_bytes(), np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    except cv2.error:  # e.g. an impossible size
        pixels = None
    if pixels is None:
        raise ValueError(f"{image.name} is not an image")
    bright = pixels[::-1] / 255.0
    return np.asarray(bright if negated else 1.0 - bright)


def _grid(header: dict[str, Any], darkness: Array) -> ImportedGrid:
    """Return the trinary grid of a map_server map: free, occupied, else unknown."""
    mode = _text(header, "mode", "trinary").lower()
    if mode not in {"trinary", "scale"}:
        raise ValueError(f"its mode is {mode}, not trinary or scale")
    origin = header.get("origin")
    if not (isinstance(origin, list) and len(origin) == 3 and all(type(v) is str for v in origin)):
        raise ValueError("its origin is not a list of x, y and yaw")
    x, y, yaw = map(float, origin)
    resolution = float(_text(header, "resolution"))
    if not (all(map(math.isfinite, (x, y, yaw))) and 0.005 <= resolution <= 1.0):
        raise ValueError("its resolution or origin is invalid")
    cells = np.full(darkness.shape, UNKNOWN, np.uint8)
    cells[darkness < float(_text(header, "free_thresh", str(FREE_BELOW)))] = FREE
    cells[darkness > float(_text(header, "occupied_thresh", str(OCCUPIED_ABOVE)))] = OCCUPIED
    return ImportedGrid(cells, resolution, np.array([x, y, yaw]))


def grid_map(grid: ImportedGrid, name: str) -> Map:
    """Return a map whose keyframes see the walls of a grid; raise `ImpError` if there are none."""
    positions = _keyframe_positions(grid)
    if len(positions) == 0 or not (grid.cells == OCCUPIED).any():
        raise ImpError(f"{name}: has no free space between walls; nothing can be localised in it")
    angles: Array = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
    scans = [
        _scan(grid.cells, grid.resolution, position, angles, MAX_RANGE) for position in positions
    ]
    poses = compose(grid.origin, np.column_stack([positions, np.zeros(len(positions))]))
    k = len(poses)
    keyframes = Keyframes(
        np.zeros(k),
        poses,
        np.tile(np.diag(SIGMA**2), (k, 1, 1)),
        np.zeros((k, 3)),
        np.zeros((k, 2)),
        np.cumsum([0, *map(len, scans)]),
        np.concatenate(scans),
        **undriven(poses),
    )
    none, rows = np.empty(0), np.empty((0, 3))
    anchors = np.empty(0, np.int64)
    tracks = (rows, np.empty((0, 6)), rows, rows, rows)
    return Map(keyframes, (), none, anchors, *tracks, about={"log": name})


def _keyframe_positions(grid: ImportedGrid) -> Array:
    """Return positions (k, 2) m in the grid's frame, covering its free space, each near the previous."""
    is_blocked = np.pad(grid.cells != FREE, 1, constant_values=True)
    clearance = distances(is_blocked, grid.resolution)[1:-1, 1:-1]
    step = max(1, round(SPACING / grid.resolution))
    best = []
    for row in range(0, clearance.shape[0], step):
        for column in range(0, clearance.shape[1], step):
            block = clearance[row : row + step, column : column + step]
            r, c = np.unravel_index(int(block.argmax()), block.shape)
            if block[r, c] >= CLEARANCE:
                best.append((column + c + 0.5, row + r + 0.5))
    return _sorted_by_proximity(np.array(best).reshape(-1, 2) * grid.resolution)


def _sorted_by_proximity(positions: Array) -> Array:
    """Return positions in an order in which each is the nearest remaining one to its predecessor."""
    remaining, order, at = np.ones(len(positions), bool), [], 0
    while remaining.any():
        order.append(at)
        remaining[at] = False
        distances = np.hypot(*(positions - positions[at]).T)
        at = int(np.argmin(np.where(remaining, distances, np.inf)))
    return positions[order]


@kernel
def _scan(
    cells: Cells, resolution: float, position: Array, angles: Array, max_range: float
) -> npt.NDArray[np.float32]:
    """Return the end points of beams on occupied cells, (n, 2) m relative to their `position` (2,)."""
    rows, columns = cells.shape
    out, n, step = np.empty((len(angles), 2), np.float32), 0, 0.5 * resolution
    for angle in angles:
        c, s = math.cos(angle), math.sin(angle)
        for k in range(1, int(max_range / step)):
            row = int((position[1] + k * step * s) / resolution)
            column = int((position[0] + k * step * c) / resolution)
            if row < 0 or column < 0 or row >= rows or column >= columns:
                break
            if cells[row, column] == FREE:
                continue
            if cells[row, column] == OCCUPIED:  # walls are a cell or two thick
                out[n, 0], out[n, 1] = k * step * c, k * step * s
                n += 1
            break
    return out[:n].copy()
