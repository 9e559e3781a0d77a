"""Writes a run as a video of the growing map, with the robot and its scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from impslam import ffmpeg
from impslam.errors import ImpError
from impslam.evaluation import colours
from impslam.evaluation.colours import INK, PATH, POINT, SCAN, WALL
from impslam.geometry.se2 import transform
from impslam.health import STATES
from impslam.map import Map
from impslam.maps.files import map_image
from impslam.maps.grid import OccupancyGrid
from impslam.observers.base import Observer, Outcome, require_placed
from impslam.observers.canvas import Canvas, Picture, colour
from impslam.observers.history import health_of
from impslam.observers.map_picture import (
    PictureContent,
    bounds,
    draw_grid,
    drawn_path,
    ellipse,
    pieces,
)
from impslam.types import Array, Ints

MAX_SECONDS, RATE = 15.0, 20.0
"""Maximum duration of a video, s, and frames per second; shorter runs are shown in real time."""
SIZE = 800
"""Length of the map's longer side, pixels. Encoding a frame takes 60 ms, or 240 ms at twice the size."""
CODECS = ("vp09", "mp4v")
"""VP9 plays in browsers and all players; MPEG-4 is for an OpenCV built without VP9."""
STATE_COLOURS = ("#15803d", "#c77700", "#d0202f")
ROBOT = np.array([[13.0, 0.0], [-8.0, 7.0], [-4.0, 0.0], [-8.0, -7.0]])
"""Outline of an arrow along x, pixels."""
Progress = Callable[[float], None]
"""Called with the share of frames written."""


class Video(Observer):
    """Writes the video at the end of a run: see `write_video`."""

    def __init__(self, path: Path, progress: Progress = lambda share: None) -> None:
        self._path, self._progress = path, progress

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Write the video."""
        write_video(self._path, known, outcome, self._progress)


def write_video(
    path: Path, known: Map, outcome: Outcome, progress: Progress = lambda share: None
) -> None:
    """Write the drive through the final map as an MP4 file, replacing an existing one.

    Raises
    ------
    ImpError
        If the file cannot be written.
    """
    require_placed(path, known)
    sessions = known.keyframes.sessions[known.anchors[known.placed()]]
    rows = _rows(known.rows().stamps, sessions)
    frames = _Frames(known, outcome)
    writer = _writer(path, frames.size)
    try:
        for number, row in enumerate(rows.tolist()):
            writer.write(frames.draw(row))
            progress((number + 1) / len(rows))
    finally:
        writer.release()


def _rows(stamps: Array, sessions: Ints) -> Ints:
    """Return the row of the path that each frame (f,) shows: the newest at its time.

    If stamps go backwards, the clock stops. The time between two sessions is left out: a continued map may
    contain drives of several days, and their clocks may differ.
    """
    starts = np.flatnonzero(np.diff(sessions, prepend=sessions[0] - 1))
    clocks = [np.maximum.accumulate(part) for part in np.split(stamps, starts[1:])]
    steps = np.concatenate([np.diff(clock, prepend=clock[0]) for clock in clocks])
    clock = np.cumsum(steps)
    count = max(2, round(RATE * min(MAX_SECONDS, float(clock[-1]))))
    times = np.linspace(0.0, clock[-1], count)
    return np.asarray(np.searchsorted(clock, times, side="right") - 1)


def _writer(path: Path, size: tuple[int, int]) -> cv2.VideoWriter:
    """Return a writer of frames of a size (columns, rows)."""
    ffmpeg.silence()
    for codec in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), RATE, size)
        if writer.isOpened():
            return writer
    raise ImpError(
        f"{path}: cannot be written as a video ({', '.join(CODECS)} tried); check folder and permissions"
    )


class _Frames:
    """Draws the frames of a run, in order of time."""

    def __init__(self, known: Map, outcome: Outcome) -> None:
        self._known, self._rows = known, known.rows()
        self._anchors = known.anchors[known.placed()]
        sessions = known.keyframes.sessions[self._anchors]
        self._path, self._breaks = drawn_path(known), np.cumsum(np.diff(sessions, prepend=0) != 0)
        self._health = health_of(known, outcome.health)
        self._grid = OccupancyGrid(outcome.config["grid"]["resolution"])
        final, none = map_image(known.grid(self._grid.resolution)), np.empty((0, 2))
        scene = PictureContent(final, self._path, none, none, known.landmarks)
        self._ground = Canvas(bounds(scene), SIZE, colours.UNSEEN)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows, both even, as codecs require."""
        rows, columns, _ = self._ground.pixels.shape
        return columns // 2 * 2, rows // 2 * 2

    def draw(self, row: int) -> Picture:
        """Return the frame at a row of the path."""
        canvas = self._ground.copy()
        anchor = int(self._anchors[row])
        self._known.keyframes.take(np.arange(anchor + 1)).draw(self._grid)
        draw_grid(canvas, map_image(self._grid))
        self._draw_landmarks(canvas, float(self._rows.stamps[: row + 1].max()))
        for piece in pieces(self._path[: row + 1 + self._breaks[row]]):
            canvas.line(piece, PATH, 2.0)
        self._draw_scan(canvas, anchor)
        self._draw_robot(canvas, row)
        columns, rows = self.size
        return np.ascontiguousarray(canvas.pixels[:rows, :columns])

    def _draw_landmarks(self, canvas: Canvas, now: float) -> None:
        """Draw the landmarks observed until `now`, s."""
        for mark in self._known.landmarks:
            if mark.first_stamp > now:
                continue
            if mark.end_points is None:
                canvas.line(ellipse(mark), POINT, 1.0, closed=True)
            else:
                canvas.line(mark.end_points, WALL, 2.0)

    def _draw_scan(self, canvas: Canvas, anchor: int) -> None:
        keyframes = self._known.keyframes
        points = keyframes.points[keyframes.starts[anchor] : keyframes.starts[anchor + 1]]
        columns, rows = canvas.pixels.shape[1::-1]
        pixels = canvas.to_pixels(transform(keyframes.poses[anchor], points.astype(np.float64)))
        x, y = np.round(pixels).astype(int).T
        inside = (x >= 1) & (x < columns) & (y >= 1) & (y < rows)
        for dx, dy in ((0, 0), (-1, 0), (0, -1), (-1, -1)):
            canvas.pixels[y[inside] + dy, x[inside] + dx] = colour(SCAN)

    def _draw_robot(self, canvas: Canvas, row: int) -> None:
        """Draw the robot, and write the time and the state of its pose."""
        pose, state = self._rows.poses[row], int(self._health.states[row])
        canvas.line(transform(pose, ROBOT / canvas.scale), "#ffffff", 3.0, closed=True)
        canvas.fill(transform(pose, ROBOT / canvas.scale), INK)
        seconds = self._rows.stamps[row] - self._rows.stamps[0]
        corner = canvas.corner + np.array([12.0, -26.0]) / canvas.scale
        text = f"{seconds:.1f} s  {STATES[state]}"
        canvas.label(corner, text, STATE_COLOURS[state], 0.7, "#ffffff")
