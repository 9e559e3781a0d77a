"""What the commands on maps share: their progress, and the picture of a map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from impslam.cli.progress import display
from impslam.errors import ConfigError, ImpError

if TYPE_CHECKING:
    from impslam.map import Map
    from impslam.maps.files import MapImage


@contextmanager
def working(what: str, quiet: bool) -> Iterator[Callable[[float], None]]:
    """Show that something is going on; call what it gives with the share done, 0 to 1, if known."""
    with display(quiet) as shown:
        if shown is None:
            yield lambda share: None
            return
        task = shown.add_task(what, total=None)
        yield lambda share: shown.update(task, total=1.0, completed=share)


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
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = {path.name for path in folder.iterdir()}
        if strange := there - files:
            raise ConfigError(
                f"{folder}: holds {min(strange)!r}, which is none of the files that are written; "
                "give -o a new or an empty folder"
            )
        for name in there:
            (folder / name).unlink()
    except OSError as error:
        raise ImpError(f"{folder}: cannot be written ({error.strerror}); give another -o") from None
    return folder


def write_picture(path: Path, known: Map, image: MapImage) -> None:
    """Draw a map: grid, path and landmarks."""
    from impslam.observers.map_picture import Scene, map_png

    none = np.empty((0, 2))
    scene = Scene(image, known.path()[:, 1:3], none, none, known.landmarks)
    write_bytes(path, map_png(scene))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file.

    Raises
    ------
    ImpError
        If it cannot be written.
    """
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ImpError(f"{path}: cannot be written ({error.strerror}); give another -o") from None
