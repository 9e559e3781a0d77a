"""The virtual IMP in a process of its own, so that what it costs and how it lags is not the host's.

`python -m impslam.platform.virtual.process` reads a `Setup` from the first line of its standard input, then
requests (`control`), and answers on its standard output. It ends when its input does, so that it
cannot outlive who started it, even if that one was killed.
"""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Self

from impslam.errors import ImpError
from impslam.platform.virtual.assembly import Setup, assemble
from impslam.platform.virtual.control import answer
from impslam.platform.virtual.imp import PERIOD, VirtualImp
from impslam.platform.virtual.rplidar import A1
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import World, load_world

START = 600.0
"""s to come up: 2 s, or minutes on a small board that compiles first. A process that ends is noticed at
once."""
END = 5.0  # s to end by itself
ANSWER = 10.0  # s to answer, on a machine that is busy
Ask = dict[str, Any]


class VirtualRobot:
    """A virtual IMP that runs beside this process; a context manager.

    Parameters
    ----------
    world : a world, the name of a shipped one, or a TOML file
    seed : of every random draw
    robot : its sensors and their faults
    options : further fields of `Setup`, such as lidar="rplidar"

    Raises
    ------
    ConfigError
        If there is no such world.
    """

    def __init__(
        self,
        world: World | str | Path = "arena",
        seed: int = 0,
        robot: SimulatedRobot | None = None,
        **options: Any,
    ) -> None:
        world = world if isinstance(world, World) else load_world(world)
        self._setup = Setup(
            world=world, robot=robot or SimulatedRobot(), seed=seed, folder=Path(), **options
        )
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._unanswered = 0
        self._lock = threading.Lock()
        self.ports: dict[str, str] = {}

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Id of the process, 0 if there is none."""
        return 0 if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process and wait until its ports are open.

        Raises
        ------
        ImpError
            If it does not come up; why stands in its log, on standard error.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="impslam-virtual-")
        setup = self._setup.model_copy(update={"folder": Path(self._folder.name)})
        self._answers, self._unanswered = queue.SimpleQueue(), 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "impslam.platform.virtual.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        listening = (self._process, self._answers)
        threading.Thread(target=_listen, args=listening, daemon=True).start()
        try:
            self.ports = self._ask(json.loads(_dumped(setup)), START)
        except BaseException:
            self.close()
            raise

    def devices(self) -> dict[str, dict[str, Any]]:
        """Return the devices of a robot file that speak to this robot."""
        tables: dict[str, dict[str, Any]] = {
            "autopilot": {"kind": "autopilot", "port": self.ports.get("autopilot")},
            "lidar": {"kind": self._setup.lidar, "port": self.ports.get("lidar")},
            "gps": {"kind": "nmea", "port": self.ports.get("gps")},
            "camera": {"kind": "camera", "source": self.ports.get("camera")},
        }
        if self._setup.lidar == "rplidar":
            tables["lidar"]["latency"] = 1.0 / A1.rate  # the emulator knows of whole turns only
        return {name: tables[name] for name in self.ports}

    def fault(self, fault: str, **what: Any) -> None:
        """Let something go wrong: `fault("unplug", device="lidar", seconds=2)`; see `faults`."""
        self._ask({"fault": fault, **what})

    def truth(self, since: float = 0.0) -> Ask:
        """Return where the robot is and what its motors do, as `VirtualImp.truth` tells it."""
        return self._ask({"ask": "truth", "since": since})

    def status(self) -> Ask:
        """Return how well it keeps up, and what its lines have counted."""
        return self._ask({"ask": "status"})

    def close(self) -> None:
        """End the process; its ports are gone when this returns."""
        process, self._process = self._process, None
        if process is not None:
            _end(process)
            self._folder.cleanup()

    def _ask(self, request: Mapping[str, Any], patience: float = ANSWER) -> Ask:
        with self._lock:
            if self._process is None or self._process.stdin is None:
                raise ImpError("the virtual IMP is not running; start it first")
            with contextlib.suppress(BrokenPipeError):  # it is told below
                self._process.stdin.write(json.dumps(request) + "\n")
                self._process.stdin.flush()
            line = self._answer(patience)
        if not line:
            self._answers.put("")  # for whoever asks next
            raise ImpError("the virtual IMP has ended; its last words are on standard error")
        reply: Ask = json.loads(line)
        if "error" in reply:
            raise ImpError(reply["error"])
        return reply

    def _answer(self, patience: float) -> str:
        """Return the answer to the last request; those to requests given up on come before."""
        end = time.monotonic() + patience
        self._unanswered += 1
        try:
            while self._unanswered:
                line = self._answers.get(timeout=max(end - time.monotonic(), 0.0))
                self._unanswered -= 1
        except queue.Empty:
            raise ImpError(f"the virtual IMP does not answer within {patience:g} s") from None
        return line


def _listen(process: subprocess.Popen[str], answers: queue.SimpleQueue[str]) -> None:
    """Take answers as they come; an empty one says that there will be no more."""
    assert process.stdout is not None
    with process.stdout as source:
        for line in source:
            answers.put(line)
    answers.put("")


def _dumped(setup: Setup) -> str:
    """Return a setup as JSON, with the infinities that a world may hold."""
    return json.dumps(setup.model_dump(mode="python"), default=str)


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    try:
        process.wait(END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# ---------------------------------------------------------------------- within the process


class _Server:
    """Reads requests in a thread, answers them in the loop that moves the robot."""

    def __init__(self, source: IO[str], sink: IO[str]) -> None:
        self._source, self._sink = source, sink
        self._requests: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._parent = os.getppid()
        self._stopped = False

    @property
    def ended(self) -> bool:
        """Whether it is told to stop, or whoever started it has died.

        The end of the input tells that too, unless another process has inherited its other end.
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
        """Answer what has been asked; does not wait."""
        while not self._requests.empty():
            self.say(answer(imp, self._requests.get()))

    def say(self, line: str) -> None:
        try:
            self._sink.write(line + "\n")
            self._sink.flush()
        except OSError:  # nobody is left to hear it
            self.stop()


def main() -> int:
    """Run a virtual IMP until standard input ends."""
    logging.basicConfig(format="imp: %(message)s")
    sink = os.fdopen(os.dup(1), "w")  # what anything prints by itself must not mix with answers
    os.dup2(2, 1)
    server = _Server(sys.stdin, sink)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started us, who then ends us
    signal.signal(signal.SIGTERM, server.stop)
    try:
        setup = Setup.model_validate(json.loads(sys.stdin.readline()))
        imp = assemble(setup)
    except (ImpError, ValueError) as error:
        server.say(json.dumps({"error": " ".join(str(error).split())}))
        return 2
    server.start()
    server.say(json.dumps(imp.ports()))
    sys.setswitchinterval(PERIOD / 2)  # the camera's threads must not hold up the loop for long
    gc.collect()
    gc.freeze()  # what has been loaded stays; looking through it again would cost 50 ms
    try:
        imp.run(lambda: server.ended, lambda: server.serve(imp))
    finally:
        imp.close()
        with contextlib.suppress(OSError):  # what else is in it is not ours
            setup.folder.rmdir()
    return 0


if __name__ == "__main__":
    sys.exit(main())
