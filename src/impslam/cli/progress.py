"""A progress bar on stderr, where that is a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from impslam.cli import waiting
from impslam.cli.console import stderr

if TYPE_CHECKING:
    from impslam.sources.base import Source

T = TypeVar("T")

PERIOD = 0.1  # s between two updates: smooth to the eye, nothing to the run


def follow(steps: Iterable[T], source: Source, display: Any, what: str) -> Iterator[T]:
    """Pass steps on and show how far the source has come."""
    due = 0.0
    task = None if display is None else display.add_task(what, total=source.total)
    for step in steps:
        yield step
        if task is not None and time.monotonic() > due:
            due = time.monotonic() + PERIOD
            display.update(task, completed=source.position)


def ticker(display: Any, what: str, total: float) -> Callable[[float], None]:
    """Return a function to call with the time reached; the first call is the beginning."""
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
    """Shows how far work has come, with a bar for each of its stages; nothing without a display."""

    def __init__(self, bars: Any, name: str) -> None:
        self._bars, self._name = bars, name
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Move the bar of a stage; see `impslam.sweeps.job.ProgressCallback`."""
        if self._bars is None:
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task("", total=total)
        said = f"{self._name}: {stage} {done}/{total}"
        self._bars.update(self._tasks[stage], description=said, completed=done, total=total)


@contextmanager
def display(quiet: bool = False) -> Iterator[Any]:
    """Give a rich display of progress, or None where nobody would see it."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    waiting.end()

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr(), transient=True) as shown:
        yield shown
