"""The virtual IMP in a process of its own (`server`), so that its load does not affect the host's."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from impslam.errors import ImpError
from impslam.platform.virtual.assembly import Setup
from impslam.platform.virtual.rplidar import A1
from impslam.simulation.world import World, load_world

START_TIMEOUT = 600.0
"""s to start: 2 s, or minutes on a small board that compiles first. If the process ends, this is noticed
at once."""
END_TIMEOUT = 5.0  # s to end by itself
ANSWER_TIMEOUT = 10.0  # s to answer, on a busy computer
ENDED = "the virtual robot has ended; standard error shows why"
Answer = dict[str, Any]


class VirtualRobot:
    """A virtual IMP that runs beside this process; a context manager.

    Parameters
    ----------
    world : a world, the name of a shipped one, or a TOML file
    seed : of every random draw
    options : further fields of `Setup`, such as lidar="rplidar" or robot

    Raises
    ------
    ConfigError
        If there is no such world.
    """

    def __init__(
        self,
        world: World | str | Path = "arena",
        seed: int = 0,
        **options: Any,
    ) -> None:
        world = world if isinstance(world, World) else load_world(world)
        self._setup = Setup(world=world, seed=seed, folder=Path(), **options)
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

    @property
    def failure(self) -> str:
        """Why it does not run any more, "" if it does, or was closed."""
        process = self._process
        return ENDED if process is not None and process.poll() is not None else ""

    def start(self) -> None:
        """Start the process and wait until its ports are open.

        Raises
        ------
        ImpError
            If it does not start; its log on standard error says why.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="impslam-virtual-")
        setup = self._setup.model_copy(update={"folder": Path(self._folder.name)})
        self._answers, self._unanswered = queue.SimpleQueue(), 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "impslam.platform.virtual.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        listening = (self._process, self._answers)
        threading.Thread(target=_listen, args=listening, daemon=True).start()
        try:
            self.ports = self._request(json.loads(_to_json(setup)), START_TIMEOUT)
        except BaseException:
            self.close()
            raise

    def devices(self) -> dict[str, dict[str, Any]]:
        """Return the devices of a robot file for this robot."""
        tables: dict[str, dict[str, Any]] = {
            "autopilot": {"kind": "autopilot", "port": self.ports.get("autopilot")},
            "lidar": {"kind": self._setup.lidar, "port": self.ports.get("lidar")},
            "gps": {"kind": "nmea", "port": self.ports.get("gps")},
            "camera": {"kind": "camera", "source": self.ports.get("camera")},
        }
        if self._setup.lidar == "rplidar":
            tables["lidar"]["latency"] = 1.0 / A1.rate  # the emulator sends whole turns
        return {name: tables[name] for name in self.ports}

    def fault(self, fault: str, **what: Any) -> None:
        """Trigger a fault: `fault("unplug", device="lidar", seconds=2)`; see `faults`."""
        self._request({"fault": fault, **what})

    def truth(self, since: float = 0.0) -> Answer:
        """Return the true pose and the speeds of the motors; see `VirtualImp.truth`."""
        return self._request({"ask": "truth", "since": since})

    def status(self) -> Answer:
        """Return lateness, CPU time and counters; see `VirtualImp.status`."""
        return self._request({"ask": "status"})

    def close(self) -> None:
        """End the process; its ports are gone when this returns."""
        process, self._process = self._process, None
        if process is not None:
            _end(process)
            self._folder.cleanup()

    def _request(self, request: Mapping[str, Any], timeout: float = ANSWER_TIMEOUT) -> Answer:
        with self._lock:
            if self._process is None or self._process.stdin is None:
                raise ImpError("the virtual robot is not running; start it first")
            with contextlib.suppress(BrokenPipeError):  # reported below
                self._process.stdin.write(json.dumps(request) + "\n")
                self._process.stdin.flush()
            line = self._receive_answer(timeout)
        if not line:
            self._answers.put("")  # for the next request
            raise ImpError(ENDED)
        reply: Answer = json.loads(line)
        if "error" in reply:
            raise ImpError(reply["error"])
        return reply

    def _receive_answer(self, timeout: float) -> str:
        """Return the answer to the last request, after those to requests that timed out."""
        end = time.monotonic() + timeout
        self._unanswered += 1
        try:
            while self._unanswered:
                line = self._answers.get(timeout=max(end - time.monotonic(), 0.0))
                self._unanswered -= 1
        except queue.Empty:
            raise ImpError(f"the virtual robot does not answer within {timeout:g} s") from None
        return line


def _listen(process: subprocess.Popen[str], answers: queue.SimpleQueue[str]) -> None:
    """Queue answers as they come; an empty one means that there will be no more."""
    assert process.stdout is not None
    with process.stdout as source:
        for line in source:
            answers.put(line)
    answers.put("")


def _to_json(setup: Setup) -> str:
    """Return a setup as JSON, with the infinities that a world may contain."""
    return json.dumps(setup.model_dump(mode="python"), default=str)


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
