"""`imp robot --virtual` as a user starts it: its process and output."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

IMP = str(Path(sys.executable).with_name("imp"))
PASSWORD = "four walls, three cylinders"
PATIENCE = 120.0  # s to come up, with all that is compiled on a fresh machine


def imp(*arguments: str, config: Path, text: str = "", timeout: float = 300.0) -> str:
    """Run `imp` to its end and return its output; `config` is the folder of the user's settings."""
    done = subprocess.run(
        [IMP, *arguments],
        env={**os.environ, "XDG_CONFIG_HOME": str(config)},
        input=text,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


class RobotProcess:
    """A running `imp robot`; a context manager, which ends it as systemd would.

    Attributes
    ----------
    address : of its page
    output : lines of its output so far
    """

    def __init__(self, *arguments: str, config: Path, folder: Path) -> None:
        self._words = ["robot", "--virtual", "--port", "0", "--folder", str(folder), *arguments]
        self._config = config
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.output: list[str] = []

    def __enter__(self) -> Self:
        self.process = subprocess.Popen(
            [IMP, *self._words],
            env={**os.environ, "XDG_CONFIG_HOME": str(self._config), "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        threading.Thread(target=self._listen, daemon=True).start()
        try:
            self.address = self.wait_for("the page is at ").rpartition(" ")[2]
        except BaseException:
            self.process.kill()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.send_signal(signal.SIGTERM)
        try:
            code = self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            code = -9
        finally:
            assert self.process.stdout is not None
            self.process.stdout.close()
        if kind is None:
            assert code == 0, "\n".join(self.output[-30:])

    def wait_for(self, words: str) -> str:
        """Return the first line with these words in it."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                line = self._lines.get(timeout=1.0)
            except queue.Empty:
                assert self.process.poll() is None, "\n".join(self.output)
                continue
            if words in line:
                return line
        raise AssertionError(f"no {words!r} in the output:\n" + "\n".join(self.output))

    def _listen(self) -> None:
        assert self.process.stdout is not None
        try:
            for line in self.process.stdout:
                self.output.append(line.rstrip())
                self._lines.put(line.rstrip())
        except ValueError:
            pass  # closed
