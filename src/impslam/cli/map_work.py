"""Progress and paths of results, shared by the `imp map` commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from impslam.cli.progress import display
from impslam.errors import ConfigError
from impslam.maps.archive import is_map
from impslam.paths import keep_inputs, written


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
    """Check that a map may be written to a path: it replaces neither an input nor anything but a map.

    Raises
    ------
    ConfigError
        If it would.
    """
    keep_inputs(inputs, [path])
    if path.exists() and not is_map(path):
        raise ConfigError(f"{path}: exists and is not a map; give another -o")


def result_folder(folder: Path, files: frozenset[str]) -> Path:
    """Create a folder for these files if needed, delete existing ones, and return it.

    Raises
    ------
    ConfigError
        If it contains anything else.
    ImpError
        If it cannot be created.
    """
    with written(folder, "give another -o"):
        folder.mkdir(parents=True, exist_ok=True)
        existing = {path.name for path in folder.iterdir()}
        if foreign := existing - files:
            raise ConfigError(
                f"{folder}: contains {min(foreign)!r}, which this command does not write; "
                "give -o a new or empty folder"
            )
        for name in existing:
            (folder / name).unlink()
    return folder
