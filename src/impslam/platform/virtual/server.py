"""The program of the process in which the virtual IMP runs; `process` starts it.

`python -m impslam.platform.virtual.server` reads a `Setup` from the first line of its standard input,
then requests (`control`), and answers on its standard output. It ends when its input does, so that it
cannot outlive the process that started it, even if that is killed.
"""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import queue
import signal
import sys
import threading
from typing import IO

from impslam.errors import ImpError
from impslam.platform.virtual.assembly import Setup, assemble
from impslam.platform.virtual.control import answer
from impslam.platform.virtual.imp import PERIOD, VirtualImp


class _RequestServer:
    """Reads requests in a thread, answers them in the loop that moves the robot."""

    def __init__(self, source: IO[str], sink: IO[str]) -> None:
        self._source, self._sink = source, sink
        self._requests: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._parent = os.getppid()
        self._stopped = False

    @property
    def ended(self) -> bool:
        """Whether it must stop, or its parent process has died.

        The end of the input indicates the latter too, unless another process has inherited its pipe.
        """
        return self._stopped or os.getppid() != self._parent

    def start(self) -> None:
        threading.Thread(target=self._listen, daemon=True).start()

    def stop(self, *_: object) -> None:
        self._stopped = True

    def _listen(self) -> None:
        for line in self._source:
            self._requests.put(line)
        self.stop()

    def serve(self, imp: VirtualImp) -> None:
        """Answer pending requests; does not block."""
        while not self._requests.empty():
            self.send(answer(imp, self._requests.get()))

    def send(self, line: str) -> None:
        try:
            self._sink.write(line + "\n")
            self._sink.flush()
        except OSError:  # the reader has gone
            self.stop()


def main() -> int:
    """Run a virtual IMP until standard input ends."""
    logging.basicConfig(format="imp: %(message)s")
    sink = os.fdopen(os.dup(1), "w")  # other output must not mix with answers
    os.dup2(2, 1)
    server = _RequestServer(sys.stdin, sink)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the parent, which then ends this
    signal.signal(signal.SIGTERM, server.stop)
    try:
        setup = Setup.model_validate(json.loads(sys.stdin.readline()))
        imp = assemble(setup)
    except (ImpError, ValueError) as error:
        server.send(json.dumps({"error": " ".join(str(error).split())}))
        return 2
    server.start()
    server.send(json.dumps(imp.ports()))
    sys.setswitchinterval(PERIOD / 2)  # the camera's threads must not delay the loop for long
    gc.collect()
    gc.freeze()  # loaded modules stay; later collections over them would take 50 ms
    try:
        imp.run(lambda: server.ended, lambda: server.serve(imp))
    finally:
        imp.close()
        with contextlib.suppress(OSError):  # other files in it may remain
            setup.folder.rmdir()
    return 0


if __name__ == "__main__":
    sys.exit(main())
