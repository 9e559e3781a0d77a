"""The virtual IMP: a body in a world, its devices, and their ports, moved in real time.

One thread moves everything, about every millisecond. When the machine comes late, time is caught up
in slices, so that each reading is of the moment at which the device would have taken it.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from impslam.errors import ConfigError
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.platform.virtual.base import Emulator
from impslam.platform.virtual.camera import CameraEmulator
from impslam.platform.virtual.faults import Delay, Fault, Malfunction, Noise, Reboot, Stall, Unplug
from impslam.platform.virtual.line import Line
from impslam.platform.virtual.urg import UrgEmulator
from impslam.simulation.body import Body
from impslam.types import Array

log = logging.getLogger(__name__)

PERIOD = 1e-3  # s between two looks at the lines
SLICE = 5e-3  # s caught up at once: half the period of the fastest device, 100 Hz
LATE = 20e-3  # s; two readings of the fastest device are due: told as late
KEPT = 10_000  # passes whose lateness is kept: 10 s
COMMANDS = 1000  # changes of the commanded speeds that are kept


class VirtualImp:
    """Body, devices and lines, and what is known about them from outside.

    Parameters
    ----------
    body : the robot
    emulators : its devices by name
    lines : the port of each of them
    """

    def __init__(
        self,
        body: Body,
        emulators: Mapping[str, Emulator],
        lines: Mapping[str, Line],
    ) -> None:
        self.body, self._emulators, self._lines = body, dict(emulators), dict(lines)
        self._camera: CameraEmulator | None = None
        self._ports = {name: line.url for name, line in self._lines.items()}
        self._blocked: dict[str, float] = {}
        self._commands: deque[tuple[float, float, float]] = deque(maxlen=COMMANDS)
        self._told = body.commanded
        self._origin, self._now = time.monotonic(), body.time
        self._lateness = np.zeros(KEPT)
        self._passes = self._late = 0

    def add_camera(self, camera: CameraEmulator) -> None:
        """Serve a camera as well; it is no byte line and has a server of its own."""
        self._camera = camera
        self._ports["camera"] = camera.serve()

    def ports(self) -> dict[str, str]:
        """Return what the host opens, by device."""
        return dict(self._ports)

    # ------------------------------------------------------------------ moving

    def run(self, stop: Callable[[], bool], serve: Callable[[], None] = lambda: None) -> None:
        """Move in real time until `stop`; `serve` is called in every pass, and must not wait."""
        due = time.monotonic()
        self._origin = due - self.body.time
        while not stop():
            late = time.monotonic() - due
            self._note(late)
            self.step(time.monotonic() - self._origin)
            serve()
            # Passes that were missed are left out: time is caught up in slices.
            due += PERIOD if late < PERIOD else late + PERIOD
            time.sleep(max(due - time.monotonic(), 0.0))

    def step(self, end: float) -> None:
        """Move on to a time in s since the beginning, and serve all lines."""
        self._now = end
        self._free()
        while end - self.body.time > SLICE:
            self._slice(self.body.time + SLICE)
        self._slice(end)
        for name, line in self._lines.items():
            data = line.receive(end)
            if data:
                self._emulators[name].receive(data, end)
        self._watch()

    def _slice(self, end: float) -> None:
        self.body.advance(end)
        for name, emulator in self._emulators.items():
            self._lines[name].send(emulator.due(end), end)

    def _free(self) -> None:
        """End the stalls whose time is over."""
        for side in [side for side, until in self._blocked.items() if self._now >= until]:
            del self._blocked[side]
            self.body.stall(side, False)

    def _watch(self) -> None:
        """Note when the motors are told something new; they obey from now on."""
        told = self._asked()
        if told[0] != self._told[0] or told[1] != self._told[1]:
            self._told = told
            self._commands.append((time.monotonic(), float(told[0]), float(told[1])))

    def _asked(self) -> Array:
        """Return the speeds (2,) m/s that the host has asked the motors for."""
        autopilot = self._emulators.get("autopilot")
        if isinstance(autopilot, AutopilotEmulator):
            return np.array(autopilot.asked)
        return self.body.commanded

    def _note(self, lateness: float) -> None:
        self._lateness[self._passes % KEPT] = lateness
        self._passes += 1
        if lateness > LATE:
            self._late += 1
            log.log(
                logging.WARNING if self._late in (100, 1000) else logging.DEBUG,
                "the virtual robot was late %d times by now, just now by %.0f ms: this computer is "
                "busy; it catches up",
                self._late,
                1e3 * lateness,
            )

    # ------------------------------------------------------------------ from outside

    def fault(self, fault: Fault) -> None:
        """Let something go wrong, from now on.

        Raises
        ------
        ConfigError
            If the device that it is for is not there.
        """
        if isinstance(fault, Stall):
            self._stall(fault)
        elif fault.device == "camera":
            self._camera_fault(fault)
        elif fault.device not in self._lines:
            raise ConfigError(f"fault {fault.fault}: this robot has no {fault.device}")
        elif isinstance(fault, Reboot):
            self._emulators[fault.device].reboot(self._now)
        elif isinstance(fault, Malfunction):
            self._fail(self._emulators[fault.device], fault.status)
        else:
            self._line_fault(self._lines[fault.device], fault, self._now + fault.seconds)

    def _stall(self, fault: Stall) -> None:
        for side in ("left", "right") if fault.side == "both" else (fault.side,):
            self._blocked[side] = self._now + fault.seconds
            self.body.stall(side, True)

    def _fail(self, emulator: Emulator, status: int) -> None:
        if not isinstance(emulator, UrgEmulator):
            raise ConfigError(
                "fault malfunction: only a URG reports a status; choose another fault"
            )
        emulator.fail(status)

    def _camera_fault(self, fault: Fault) -> None:
        if self._camera is None:
            raise ConfigError(f"fault {fault.fault}: this robot has no camera")
        if isinstance(fault, Unplug):
            self._camera.unplug(fault.seconds)
        elif isinstance(fault, Delay):
            self._camera.freeze(fault.seconds)

    def _line_fault(self, line: Line, fault: Noise | Delay | Unplug, until: float) -> None:
        if isinstance(fault, Noise):
            line.noise(fault.rate, fault.kind, until)
        elif isinstance(fault, Delay):
            line.hold(until)
        else:
            line.unplug(until)

    def pose(self) -> Array:
        """Return the true pose (3,); from any thread."""
        return self.body.pose

    def truth(self, since: float = 0.0) -> dict[str, Any]:
        """Return where the robot is, what its motors do, and what they were told.

        Times are on the machine's monotonic clock (s), which all its processes share; `commands`
        are [time, left, right], m/s, after `since`: when the motors began to obey it.
        """
        body = self.body
        return {
            "monotonic": self._origin + body.time,
            "time": body.time,
            "pose": body.pose.tolist(),
            "twist": body.twist.tolist(),
            "motors": body.motors.tolist(),
            "told": self._asked().tolist(),
            "stalled": sorted(self._blocked),
            "commands": [entry for entry in self._commands if entry[0] > since],
        }

    def status(self) -> dict[str, Any]:
        """Return how well it keeps up (lateness and processor time in s), and its lines' counts."""
        kept = self._lateness[: max(1, min(self._passes, KEPT))]
        p50, p99 = np.percentile(kept, (50, 99)).tolist()
        return {
            "passes": self._passes,
            "late": self._late,
            "cpu": time.process_time(),
            "lateness": {"p50": p50, "p99": p99, "max": float(kept.max())},
            "lines": {name: dict(line.counts) for name, line in self._lines.items()},
        }

    def close(self) -> None:
        """Take all ports away."""
        for line in self._lines.values():
            line.close()
        if self._camera is not None:
            self._camera.close()
