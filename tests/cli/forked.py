"""Commands in processes of their own, forked from one that has imported and loaded what they need.

A fresh interpreter spends 1.9 s on imports and on loading machine code, and 0.7 s on mapping 100 scans.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Self

from impslam.cli import main

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.cli.warm"])


def _run(out: Connection, err: Connection, setup: str, words: list[str]) -> None:
    os.dup2(out.fileno(), 1)
    os.dup2(err.fileno(), 2)
    # As in a new interpreter that no `nohup` has told to ignore SIGHUP.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    exec(setup, {})
    sys.exit(main(words))


class Forked:
    """`imp` with these words, after some lines of Python, as a `subprocess.Popen` with text pipes."""

    def __init__(self, *words: object, setup: str = "") -> None:
        readers, writers = zip(*(CONTEXT.Pipe(duplex=False) for _ in "12"), strict=True)
        self._process = CONTEXT.Process(target=_run, args=(*writers, setup, [*map(str, words)]))
        self._process.start()
        for writer in writers:
            writer.close()
        self.stdout, self.stderr = (os.fdopen(os.dup(r.fileno()), "r") for r in readers)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        if error is not None:
            self._process.kill()
        self._process.join()
        self.stdout.close()
        self.stderr.close()

    def poll(self) -> int | None:
        """Return the exit code, or None while the process runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """The exit code, or None while the process runs."""
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to the process."""
        os.kill(self._process.pid, number)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for the end, at most `timeout` s; return what it printed, which has to fit into a pipe."""
        self._process.join(timeout)
        assert self._process.exitcode is not None, f"the process still runs after {timeout} s"
        return self.stdout.read(), self.stderr.read()
