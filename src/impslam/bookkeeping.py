"""Counts, times and problems of a run."""

from __future__ import annotations

import functools
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from typing import Any

import numpy as np

from impslam.geometry.kernels import compile_seconds
from impslam.observers.base import Dropped, Outcome
from impslam.provenance import versions
from impslam.sources.base import Problems


class Stopwatch:
    """Measures seconds per stage, with one entry per execution."""

    def __init__(self) -> None:
        self.stages: dict[str, array[float]] = {}
        self._begin, self._compiled = time.perf_counter(), compile_seconds()

    @property
    def compiling(self) -> float:
        """Seconds since creation in which kernels were compiled."""
        return compile_seconds() - self._compiled

    @property
    def elapsed(self) -> float:
        """Seconds since creation."""
        return time.perf_counter() - self._begin

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure the duration of a block."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._add(stage, begin)

    def each(self, stage: str, items: Iterable[Any]) -> Iterator[Any]:
        """Yield items, and measure how long each takes to compute."""
        iterator, begin = iter(items), time.perf_counter()
        for item in iterator:
            self._add(stage, begin)
            yield item
            begin = time.perf_counter()

    def _add(self, stage: str, begin: float) -> None:
        self.stages.setdefault(stage, array("d")).append(time.perf_counter() - begin)


def dropped(parts: Iterable[Problems]) -> dict[str, Dropped]:
    """Merge the problems of several parts: the counts are added, and the first example is kept."""
    merged = Problems()
    for problems in parts:
        for kind, count in problems.counts.items():
            merged.add(kind, problems.examples[kind], count)
    return {kind: Dropped(count, merged.examples[kind]) for kind, count in merged.counts.items()}


def about(outcome: Outcome, logs: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """Return the origin of a map as JSON values, which are equal for equal runs.

    `logs` are all logs of the map, in their order.
    """
    return {
        "log": outcome.log.name,
        "log_sha256": outcome.log_sha256,
        "logs": list(logs),
        "partial": outcome.partial,
        "config": dict(outcome.config),
        "counts": dict(sorted(outcome.counts.items())),
        "versions": versions(),
    }


def seal(*values: object) -> None:
    """Make the arrays passed to observers read-only, except those of sweeps."""
    for value in values:
        kind: Any = type(value)
        for part in _parts_of(kind)(value):
            if type(part) is np.ndarray:
                part.setflags(write=False)


@functools.cache
def _parts_of(kind: type[Any]) -> Callable[[object], tuple[object, ...]]:
    return attrgetter(*(getattr(kind, "_fields", None) or kind.__dataclass_fields__))
