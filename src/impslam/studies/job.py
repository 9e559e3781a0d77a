"""How much a study is to do, and the processes that share its work."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeAlias, TypeVar

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
    """

    seeds: int | None = None
    processes: int = 1
    progress: ProgressCallback = ignore_progress

    def map(self, work: Callable[[T], R], items: Iterable[T], stage: str) -> list[R]:
        """Return the results of independent work, in the order of the items.

        `work` and items must be picklable.
        """
        todo = list(items)
        if self.processes == 1 or len(todo) < 2:
            return self._collect(map(work, todo), len(todo), stage)
        with ProcessPoolExecutor(self.processes, get_context("spawn")) as pool:
            return self._collect(pool.map(work, todo), len(todo), stage)

    def _collect(self, results: Iterable[R], total: int, stage: str) -> list[R]:
        self.progress(stage, 0, total)
        collected = []
        for result in results:
            collected.append(result)
            self.progress(stage, len(collected), total)
        return collected
