"""Progress bars on stderr, if it is a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from impslam.cli import startup_notice
from impslam.cli.console import stderr

if TYPE_CHECKING:
    from impslam.sources.base import Source

T = TypeVar("T")

UPDATE_INTERVAL = 0.1  # s, short enough to look smooth, long enough not to slow the run


def with_progress(steps: Iterable[T], source: Source, display: Any, what: str) -> Iterator[T]:
    """Yield the steps and show the position in the source."""
    due = 0.0
    task = None if display is None else display.add_task(what, total=source.total)
    for step in steps:
        yield step
        if task is not None and time.monotonic() > due:
            due = time.monotonic() + UPDATE_INTERVAL
            display.update(task, completed=source.position)


def ticker(display: Any, what: str, total: float) -> Callable[[float], None]:
    """Return a function to call with the current time; the first call sets the start."""
    if display is None:
        return lambda now: None
    task = display.add_task(what, total=total)
    begin: list[float] = []

    def tick(now: float) -> None:
        if not begin:
            begin.append(now)
        display.update(task, completed=now - begin[0])

    return tick


class StageBars:
    """Shows a progress bar for each stage of the work, or nothing if `bars` is None."""

    def __init__(self, bars: Any, name: str) -> None:
        self._bars, self._name = bars, name
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Update the bar of a stage; see `impslam.sweeps.job.ProgressCallback`."""
        if self._bars is None:
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task("", total=total)
        text = f"{self._name}: {stage} {done}/{total}"
        self._bars.update(self._tasks[stage], description=text, completed=done, total=total)


@contextmanager
def display(quiet: bool = False) -> Iterator[Any]:
    """Yield a rich progress display, or None if quiet or if stderr is not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    startup_notice.end()

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr(), transient=True) as progress:
        yield progress
