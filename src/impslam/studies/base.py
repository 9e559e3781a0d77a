"""What an experiment is given, and what comes out: tables, pictures and figures for one section."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any, TypeAlias, TypeVar

T = TypeVar("T")
R = TypeVar("R")

Tick: TypeAlias = Callable[[str, int, int], None]
"""Is told what is being done, how many parts of it are done, and of how many."""


def _nobody(what: str, done: int, total: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table as people read it: cells are text, with their units in the header.

    The first `text` columns are words, the others numbers. `note` says in a sentence what to see.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int = 1
    note: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture: the stem of its file, the PNG, and what it shows."""

    name: str
    png: bytes = field(repr=False)
    caption: str


@dataclass(frozen=True, slots=True)
class Part:
    """One section of the page: what was done and what came out.

    `figures` are the numbers behind the tables by name, in m, rad, s or 1, for other programs.
    """

    name: str
    title: str
    text: str
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """How much an experiment is to do.

    Attributes
    ----------
    seeds : number of simulated runs, of seeds 0, 1, ...; an experiment's own number where None
    processes : among which they are shared; the results do not depend on it
    tick : is told of progress
    """

    seeds: int | None = None
    processes: int = 1
    tick: Tick = _nobody

    def map(self, work: Callable[[T], R], items: Iterable[T], what: str) -> list[R]:
        """Return the results of independent work, in order; `work` must be picklable."""
        todo = list(items)
        if self.processes == 1:
            return self._collect(map(work, todo), len(todo), what)
        with ProcessPoolExecutor(self.processes, get_context("spawn")) as pool:
            return self._collect(pool.map(work, todo), len(todo), what)

    def _collect(self, results: Iterable[R], total: int, what: str) -> list[R]:
        self.tick(what, 0, total)
        collected = []
        for result in results:
            collected.append(result)
            self.tick(what, len(collected), total)
        return collected


Experiment: TypeAlias = Callable[[Job], Part]
"""An experiment is a function; `impslam.cli.reproduce` knows them by name."""
