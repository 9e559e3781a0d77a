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
class ProcessDied:
    """Result of work whose process died: killed, or out of memory."""

    why: str


class Pool(ABC):
    """Does independent work. Work and items must be picklable."""

    @abstractmethod
    def each(
        self, work: Callable[[T], R], items: Iterable[T]
    ) -> Iterator[tuple[int, R | ProcessDied]]:
        """Yield the index of each item and its result, in the order of completion.

        Items are taken only when a process is free, so an item may depend on earlier results. Exceptions of
        `work` propagate and end the iteration.
        """


@dataclass(frozen=True, slots=True)
class ThisProcess(Pool):
    """The current process does one item after the other; their work need not be picklable."""

    def each(
        self, work: Callable[[T], R], items: Iterable[T]
    ) -> Iterator[tuple[int, R | ProcessDied]]:
        """Yield results; see `Pool.each`."""
        return ((index, work(item)) for index, item in enumerate(items))


@dataclass(frozen=True, slots=True)
class Processes(Pool):
    """Processes on this machine. They can be stopped at any time: none of their code runs in this one."""

    count: int = 1

    def each(
        self, work: Callable[[T], R], items: Iterable[T]
    ) -> Iterator[tuple[int, R | ProcessDied]]:
        """Yield results; see `Pool.each`. Items whose process dies are retried once, one at a time."""
        todo = enumerate(items)
        while suspects := (yield from self._until_broken(work, todo)):
            for index, item in suspects.items():
                yield index, run_in_process(work, item)

    def _until_broken(
        self, work: Callable[[T], R], todo: Iterator[tuple[int, T]]
    ) -> Generator[tuple[int, R | ProcessDied], None, dict[int, T]]:
        """Yield results until a process dies; return the items in progress at that time.

        No more items are submitted than there are processes, so one of those in progress is the cause.
        """
        in_progress: dict[int, T] = {}
        running: dict[Future[R], int] = {}
        with _executor(self.count) as pool, suppress(BrokenProcessPool):
            while True:
                for index, item in islice(todo, self.count - len(in_progress)):
                    in_progress[index] = item
                    running[pool.submit(work, item)] = index
                if not running:
                    return {}
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    result, index = future.result(), running.pop(future)
                    del in_progress[index]
                    yield index, result
        return in_progress


def run_in_process(work: Callable[[T], R], item: T) -> R | ProcessDied:
    """Return the result of one item, computed in a process of its own."""
    with _executor(1) as pool:
        try:
            return pool.submit(work, item).result()
        except BrokenProcessPool:
            return ProcessDied(
                "its process was killed twice: out of memory, or by the system; see dmesg"
            )


@contextmanager
def _executor(count: int) -> Iterator[ProcessPoolExecutor]:
    """Provide processes; terminate them at once if the block fails or is interrupted."""
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
    """Ignore Ctrl-C, which every process of a terminal receives, and exit with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
