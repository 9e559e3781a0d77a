"""A job of independent work: its size, its processes and its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

from impslam.errors import ImpError
from impslam.sweeps.pool import ProcessDied, Processes, ThisProcess

T = TypeVar("T")
R = TypeVar("R")

ProgressCallback: TypeAlias = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of finished parts, and the total number of parts."""


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True)
class Job:
    """Size and execution of a study.

    Attributes
    ----------
    seeds : number of simulated runs, of seeds 0, 1, ...; None for the study's default
    processes : number of processes; the results do not depend on it, and 1 is the current process
    progress : called after each part of the work
    data : folder of the public logs, for studies that use them
    """

    seeds: int | None = None
    processes: int = 1
    progress: ProgressCallback = ignore_progress
    data: Path | None = None

    def map(self, work: Callable[[T], R], items: Iterable[T], stage: str) -> list[R]:
        """Return the results of independent work, in the order of the items.

        `work` and items must be picklable.

        Raises
        ------
        ImpError
            If a process is killed.
        """
        todo = list(items)
        results: dict[int, R] = {}
        self.progress(stage, 0, len(todo))
        count = min(self.processes, len(todo))
        pool = Processes(count) if count > 1 else ThisProcess()
        for index, result in pool.each(work, todo):
            if isinstance(result, ProcessDied):
                raise ImpError(f"{stage}: {result.why}")
            results[index] = result
            self.progress(stage, len(results), len(todo))
        return [results[index] for index in range(len(todo))]
