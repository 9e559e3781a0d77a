"""Files of a simulated overhead camera: the video, pictures of a board, and the measured setup."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import tomli_w

from impslam import ffmpeg
from impslam.errors import ConfigError
from impslam.overhead.camera import CalibratedCamera
from impslam.overhead.setup import Board, Discs, Floor, FloorPoint, Marker, Setup
from impslam.simulation.drive import Trajectory
from impslam.simulation.overhead import (
    CYLINDER_HEIGHT,
    FLOOR_IDS,
    ORANGE,
    Film,
    blurred,
    floor_points,
)  # fmt: skip
from impslam.simulation.overhead_paint import Brush, Pixels, card
from impslam.simulation.robot import OverheadCamera
from impslam.simulation.scene import Scene
from impslam.simulation.simulate import ticks
from impslam.types import Array

CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}
VIEWS = 16  # number of pictures of the board
BOARD = Board(columns=10, rows=7, square=0.04, views="board")
OUTLINE = BOARD.square * np.array([[x, y, 0] for x in (-6.0, 6.0) for y in (-4.5, 4.5)])
SHARES = (0.3, 0.5)  # range of the share of the picture's width that the board fills
SLANT = 0.6  # rad, maximum tilt of the board


def write_film(
    path: Path,
    device: OverheadCamera,
    scene: Scene,
    trajectory: Trajectory,
    start: float,
    seed: int,
    tick: Callable[[float], None],
) -> None:
    """Write a video of a run, `NAME.board/` with pictures of a board, and the setup `NAME.toml`.

    Parameters
    ----------
    start : stamp of the start of the run, s
    tick : called with the current time of the film, s

    Raises
    ------
    ConfigError
        If the camera does not see the whole path, or the video cannot be written.
    """
    streams = [np.random.default_rng([seed, number]) for number in range(3)]
    film = Film(device, scene, trajectory, streams[0])
    _write_video(path, device, film, trajectory.duration, tick)
    folder = path.with_name(f"{path.stem}.board")
    folder.mkdir(exist_ok=True)
    for number, view in enumerate(_views(device, film.camera, streams[1])):
        cv2.imwrite(str(folder / f"{number:02d}.png"), view)
    setup = _measured(device, scene, film.camera, streams[2], folder.name, start)
    text = tomli_w.dumps(setup.model_dump(exclude_none=True))
    path.with_suffix(".toml").write_text(text, encoding="utf-8")


def _write_video(
    path: Path, device: OverheadCamera, film: Film, duration: float, tick: Callable[[float], None]
) -> None:
    if path.suffix.lower() not in CODECS:
        raise ConfigError(f"{path}: the name of a video must end in {', '.join(CODECS)}")
    codec = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
    size = device.width, device.height
    ffmpeg.silence()
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, device.rate, size)
    if not writer.isOpened():
        raise ConfigError(f"{path}: cannot be written as {CODECS[path.suffix.lower()]}; try .avi")
    try:
        for time in ticks(device.rate, duration).tolist():
            writer.write(film.picture(time))
            tick(time)
    finally:
        writer.release()


def _views(
    device: OverheadCamera, camera: CalibratedCamera, rng: np.random.Generator
) -> Iterator[Pixels]:
    """Yield pictures of a board at various positions in the picture and various tilts."""
    brush = Brush(camera)
    squares = np.indices((BOARD.rows, BOARD.columns)).sum(axis=0) % 2 * 255
    paint = card(squares.astype(np.uint8), BOARD.columns * BOARD.square, BOARD.square)
    for number in range(VIEWS):
        held = brush.with_extrinsics(_extrinsics(device, number, rng))
        canvas = np.full((device.height, device.width, 3), 110.0, np.float32)
        box = held.box(OUTLINE)
        if box is not None:
            held.stamp(canvas[box], box, 0.0, paint, samples=2)
        grain = device.noise * rng.standard_normal(canvas.shape, np.float32)
        yield np.clip(blurred(canvas, device.blur) + grain, 0, 255).astype(np.uint8)


def _extrinsics(device: OverheadCamera, number: int, rng: np.random.Generator) -> Array:
    """Return the camera's extrinsics (6,) relative to the board in a view."""
    share = rng.uniform(*SHARES)
    depth = device.focal * BOARD.columns * BOARD.square / (share * device.width)
    position = np.array([number % 4, number // 4]) / 3.0 - 0.5  # a grid of 4 x 4
    side = position * (1.0 - 1.2 * share) * np.array([device.width, device.height]) / device.focal
    facing = np.diag([1.0, -1.0, -1.0])  # the board's x to the right, its y up
    turned = cv2.Rodrigues(rng.uniform(-SLANT, SLANT, 3))[0] @ facing
    return np.concatenate([cv2.Rodrigues(turned)[0].ravel(), depth * side, [depth]])


def _measured(
    device: OverheadCamera,
    scene: Scene,
    camera: CalibratedCamera,
    rng: np.random.Generator,
    board: str,
    start: float,
) -> Setup:
    """Return the setup as measured by tape, with an error in each length."""
    sigma = device.survey_sigma
    measured = floor_points(camera) + sigma * rng.standard_normal((len(FLOOR_IDS), 2))
    points = tuple(
        FloorPoint(x=x, y=y, marker=number)
        for (x, y), number in zip(measured.round(4).tolist(), FLOOR_IDS, strict=True)
    )
    height = round(device.marker_height + sigma * float(rng.standard_normal()), 4)
    marker = Marker(size=device.marker_size, height=height, height_sigma=sigma)
    radii = tuple(np.unique(scene.circles[:, 2]).tolist())
    colour = "#" + "".join(f"{part:02x}" for part in ORANGE)
    discs = Discs(colour=colour, height=CYLINDER_HEIGHT, radii=radii) if radii else None
    floor = Floor(points=points, sigma=sigma)
    shown = BOARD.model_copy(update={"views": board})
    return Setup(start=start, board=shown, floor=floor, marker=marker, discs=discs)
