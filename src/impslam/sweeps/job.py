"""How much is to be done, the processes that share it, and how far it has come."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

from impslam.errors import ImpError
from impslam.sweeps.pool import Lost, Processes

T = TypeVar("T")
R = TypeVar("R")

ProgressCallback: TypeAlias = Callable[[str, int, int], None]
"""Is called with the name of a stage, how many of its parts are done, and how many there are."""


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True)
class Job:
    """How much a study is to do.

    Attributes
    ----------
    seeds : number of simulated runs, of seeds 0, 1, ...; the study's own number where None
    processes : number of processes; the results do not depend on it
    progress : is called after each part of the work
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
        pool = Processes(min(self.processes, max(1, len(todo))))
        for index, result in pool.each(work, todo):
            if isinstance(result, Lost):
                raise ImpError(f"{stage}: {result.why}")
            results[index] = result
            self.progress(stage, len(results), len(todo))
        return [results[index] for index in range(len(todo))]
