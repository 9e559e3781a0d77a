"""Independent work, shared by processes of this machine or by the workers of a Dask cluster."""

from __future__ import annotations

import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Lost:
    """Stands for the result of work whose process has ended: killed, or out of memory."""

    why: str


class Pool(ABC):
    """Does independent work. Work and items must be picklable."""

    @abstractmethod
    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[int, R | Lost]]:
        """Yield the index of each item and its result, in the order in which they are done.

        Items are taken when there is a process for them: one may depend on the results before it. What
        `work` raises ends the iteration.
        """


@dataclass(frozen=True, slots=True)
class Processes(Pool):
    """Processes of this machine; with one of them, this process does the work."""

    count: int = 1

    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[int, R | Lost]]:
        """Yield results; see `Pool.each`. An item whose process ends is tried once more, alone."""
        todo = enumerate(items)
        if self.count == 1:
            yield from ((index, work(item)) for index, item in todo)
            return
        while suspects := (yield from self._until_broken(work, todo)):
            for index, item in suspects.items():
                yield index, alone(work, item)

    def _until_broken(
        self, work: Callable[[T], R], todo: Iterator[tuple[int, T]]
    ) -> Generator[tuple[int, R | Lost], None, dict[int, T]]:
        """Yield results until a process ends; return the items that were at work then.

        No more items are handed out than there are processes: one of those at work is to blame.
        """
        at_work: dict[int, T] = {}
        running: dict[Future[R], int] = {}
        with _executor(self.count) as pool, suppress(BrokenProcessPool):
            while True:
                for index, item in islice(todo, self.count - len(at_work)):
                    at_work[index] = item
                    running[pool.submit(work, item)] = index
                if not running:
                    return {}
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    result, index = future.result(), running.pop(future)
                    del at_work[index]
                    yield index, result
        return at_work


def alone(work: Callable[[T], R], item: T) -> R | Lost:
    """Return the result of one item by a process of its own."""
    with _executor(1) as pool:
        try:
            return pool.submit(work, item).result()
        except BrokenProcessPool:
            return Lost("its process was killed twice: out of memory, or by the system; see dmesg")


@contextmanager
def _executor(count: int) -> Iterator[ProcessPoolExecutor]:
    """Give processes; where the block fails or is interrupted, they are ended at once."""
    others = set(active_children())
    pool = ProcessPoolExecutor(count, get_context("spawn"), _begin_process)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(active_children()) - others:
            process.terminate()
        raise
    pool.shutdown()


def _begin_process() -> None:
    """Leave Ctrl-C, which every process of a terminal gets, to the parent; end when the parent does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
