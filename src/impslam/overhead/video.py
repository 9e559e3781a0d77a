"""Read pictures, with their times, from a video, or pictures from a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from impslam import ffmpeg
from impslam.errors import ImpError

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}


class VideoFile:
    """A video file, open for reading.

    Attributes
    ----------
    width, height : px
    pictures : number of pictures according to the header
    rate : pictures per second
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise ImpError(f"{path}: no such video; check the path")
        ffmpeg.silence()
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise ImpError(
                f"{path}: is not a readable video; convert it, e.g. with ffmpeg -i IN OUT.mp4"
            )
        # Phones store their orientation in the header; use pixels as displayed.
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self.pictures = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if not (self.width and self.height):
            raise ImpError(f"{path}: contains no picture; record it again")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def __iter__(self) -> Iterator[tuple[float, Any]]:
        """Yield times since the first picture, s, and pictures (height, width, 3)."""
        first, last, number = 0.0, -np.inf, 0
        while True:
            good, picture = self._capture.read()
            if not good:
                break
            time = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
            if number == 0:
                first = time
            elif time - first <= last:  # some files have no times
                time = first + number / (self.rate or 1.0)
            last = time - first
            number += 1
            yield last, picture
        if number == 0:
            raise ImpError(f"{self._path}: contains no picture; record it again")

    def sample(self, number: int) -> list[Any]:
        """Return a number of pictures, evenly spread over the video."""
        wanted = set(np.linspace(0, max(self.pictures - 1, 0), number).round().astype(int).tolist())
        chosen = []
        for k in range(self.pictures):
            if not self._capture.grab():
                break
            if k in wanted:
                chosen.append(self._capture.retrieve()[1])
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
        if not chosen:
            raise ImpError(f"{self._path}: contains no picture; record it again")
        return chosen


def read_pictures(path: Path, max_count: int) -> list[Any]:
    """Return pictures of a folder, or pictures evenly spread over a video.

    Raises
    ------
    ImpError
        If there are none, or one cannot be read.
    """
    if not path.is_dir():
        with VideoFile(path) as video:
            return video.sample(max_count)
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in PICTURES)
    if not files:
        raise ImpError(f"{path}: contains no picture (.png, .jpg, ...); check the path")
    pictures = []
    for file in files[:max_count]:
        picture = cv2.imread(str(file))
        if picture is None:
            raise ImpError(f"{file}: is not a readable picture; remove it")
        pictures.append(picture)
    return pictures
