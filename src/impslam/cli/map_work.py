"""Progress and paths of results, shared by the `imp map` commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any

from impslam.cli.progress import display
from impslam.errors import ConfigError
from impslam.maps.archive import check_replaceable
from impslam.paths import keep_inputs, written

_PART = ".part"
"""Folder of files that are not complete yet."""


class Progress:
    """A line of a progress display, or nothing if the display is None."""

    def __init__(self, display: Any, what: str) -> None:
        self._display, self._what = display, what
        self._task = None if display is None else display.add_task(what, total=None)

    def __call__(self, share: float) -> None:
        """Show the share of the work that is done, 0 to 1."""
        self.step(self._what, share)

    def step(self, what: str, share: float) -> None:
        """Show the current step and the share of it that is done."""
        if self._display is not None:
            self._display.update(self._task, description=what, total=1.0, completed=share)


@contextmanager
def progress_line(what: str, quiet: bool) -> Iterator[Progress]:
    """Show that work is in progress; yield a callback for the share that is done."""
    with display(quiet) as bars:
        yield Progress(bars, what)


def check_map_path(path: Path, inputs: Sequence[Path]) -> None:
    """Check that a map may be written to a path: as a map, replacing neither an input nor anything else.

    Raises
    ------
    ConfigError
        If it would.
    """
    keep_inputs(inputs, [path])
    check_replaceable(path)
    if path.suffix != ".imp":
        raise ConfigError(f"{path}: the file name must end in .imp")


@contextmanager
def result_folder(folder: Path, files: frozenset[str]) -> Iterator[Path]:
    """Yield an empty folder for some of these files; they replace those in `folder` if the block succeeds.

    If it fails, `folder` is as before. The yielded folder is inside it, because `folder` may be a mount
    point or the current folder. One left by a killed process is removed.

    Raises
    ------
    ConfigError
        If `folder` contains anything else.
    ImpError
        If it cannot be written to.
    """
    part, is_new = folder / _PART, not folder.exists()
    with written(folder, "give another -o"):
        folder.mkdir(parents=True, exist_ok=True)
        _check_contents(folder, files | {_PART})
        rmtree(part, ignore_errors=True)
        part.mkdir()
    try:
        yield part
        with written(folder, "give another -o"):
            for name in files:
                if (part / name).exists():
                    (part / name).replace(folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
    except BaseException:
        rmtree(folder if is_new else part, ignore_errors=True)
        raise
    part.rmdir()


def _check_contents(folder: Path, files: frozenset[str]) -> None:
    """Raise `ConfigError` if a folder contains anything but these files."""
    if foreign := {path.name for path in folder.iterdir()} - files:
        raise ConfigError(
            f"{folder}: contains {min(foreign)!r}, which this command does not write; "
            "give -o a new or empty folder"
        )
