"""What the commands on maps share: their progress, and the picture of a map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impslam.cli.progress import display
from impslam.errors import ConfigError
from impslam.paths import written

if TYPE_CHECKING:
    from impslam.map import Map
    from impslam.maps.files import MapImage


class Work:
    """What is going on, on a display of progress, or nowhere if that is None."""

    def __init__(self, display: Any, what: str) -> None:
        self._display, self._what = display, what
        self._task = None if display is None else display.add_task(what, total=None)

    def __call__(self, share: float) -> None:
        """Show the share that is done, 0 to 1."""
        self.step(self._what, share)

    def step(self, what: str, share: float) -> None:
        """Show what is being done now, and the share of it that is done."""
        if self._display is not None:
            self._display.update(self._task, description=what, total=1.0, completed=share)


@contextmanager
def working(what: str, quiet: bool) -> Iterator[Work]:
    """Show that something is going on, and how far it has come as soon as that is told."""
    with display(quiet) as shown:
        yield Work(shown, what)


def picture_path(beside: Path, wanted: Path | None) -> Path:
    """Return where a picture goes: the PNG asked for, or one beside a file, with its name."""
    if wanted is not None and wanted.suffix.lower() != ".png":
        raise ConfigError(f"{wanted}: is drawn as a PNG; give -o NAME.png")
    return wanted or beside.with_suffix(".png")


def result_folder(folder: Path, files: frozenset[str]) -> Path:
    """Return a folder to write these files to, made if need be, emptied of those of an earlier time.

    Raises
    ------
    ConfigError
        If it holds anything else.
    ImpError
        If it cannot be made.
    """
    with written(folder, "give another -o"):
        folder.mkdir(parents=True, exist_ok=True)
        there = {path.name for path in folder.iterdir()}
        if strange := there - files:
            raise ConfigError(
                f"{folder}: holds {min(strange)!r}, which is none of the files that are written; "
                "give -o a new or an empty folder"
            )
        for name in there:
            (folder / name).unlink()
    return folder


def write_picture(path: Path, known: Map, image: MapImage) -> None:
    """Draw a map: grid, path and landmarks."""
    from impslam.observers.map_picture import Scene, drawn_path, map_png

    none = np.empty((0, 2))
    scene = Scene(image, drawn_path(known), none, none, known.landmarks)
    write_bytes(path, map_png(scene))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file.

    Raises
    ------
    ImpError
        If it cannot be written.
    """
    with written(path, "give another -o"):
        path.write_bytes(data)
