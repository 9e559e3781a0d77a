"""The virtual IMP: a body in a world, its devices, and their ports, simulated in real time.

One thread advances everything, about every millisecond. When the computer is late, it catches up in
slices, so that each reading is of the time at which the device would have taken it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from impslam.errors import ConfigError
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.platform.virtual.base import Emulator
from impslam.platform.virtual.camera import CameraEmulator
from impslam.platform.virtual.faults import (
    Carry,
    Delay,
    Fault,
    LineNoise,
    Malfunction,
    Reboot,
    Stall,
    Unplug,
)
from impslam.platform.virtual.lateness import LatenessLog
from impslam.platform.virtual.line import Line
from impslam.platform.virtual.urg import UrgEmulator
from impslam.simulation.body import Body
from impslam.types import Array

PERIOD = 1e-3  # s between passes
SLICE = 5e-3  # s advanced at once: half the period of the fastest device, 100 Hz
MAX_COMMANDS = 1000  # changes of the commanded speeds kept


class VirtualImp:
    """Body, devices and lines of a virtual robot.

    Parameters
    ----------
    body : the robot
    emulators : its devices by name
    lines : their ports by name
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
        self._commands: deque[tuple[float, float, float]] = deque(maxlen=MAX_COMMANDS)
        self._last_command = body.commanded
        self._origin, self._now = time.monotonic(), body.time
        self._lateness = LatenessLog()

    def add_camera(self, camera: CameraEmulator) -> None:
        """Serve a camera, which has its own server instead of a line."""
        self._camera = camera
        self._ports["camera"] = camera.serve()

    def ports(self) -> dict[str, str]:
        """Return the ports that the host opens, by device."""
        return dict(self._ports)

    # ------------------------------------------------------------------ moving

    def run(self, stop: Callable[[], bool], serve: Callable[[], None] = lambda: None) -> None:
        """Run in real time until `stop`; `serve` is called in every pass, and must not block."""
        due = time.monotonic()
        self._origin = due - self.body.time
        while not stop():
            late = time.monotonic() - due
            self._lateness.add(late)
            self.step(time.monotonic() - self._origin)
            serve()
            # Missed passes are skipped; `step` catches up in slices.
            due += PERIOD if late < PERIOD else late + PERIOD
            time.sleep(max(due - time.monotonic(), 0.0))

    def step(self, end: float) -> None:
        """Advance to a time, s since the start, and serve all lines."""
        self._now = end
        self._end_stalls()
        while end - self.body.time > SLICE:
            self._advance(self.body.time + SLICE)
        self._advance(end)
        for name, line in self._lines.items():
            data = line.receive(end)
            if data:
                self._emulators[name].receive(data, end)
        self._record_commands()

    def _advance(self, end: float) -> None:
        self.body.advance(end)
        for name, emulator in self._emulators.items():
            self._lines[name].send(emulator.due(end), end)

    def _end_stalls(self) -> None:
        """End expired stalls."""
        for side in [side for side, until in self._blocked.items() if self._now >= until]:
            del self._blocked[side]
            self.body.stall(side, False)

    def _record_commands(self) -> None:
        """Record a change of the commanded speeds, which takes effect now."""
        speeds = self._commanded_speeds()
        if speeds[0] != self._last_command[0] or speeds[1] != self._last_command[1]:
            self._last_command = speeds
            self._commands.append((time.monotonic(), float(speeds[0]), float(speeds[1])))

    def _commanded_speeds(self) -> Array:
        """Return the speeds (2,) that the host commands, m/s."""
        autopilot = self._emulators.get("autopilot")
        if isinstance(autopilot, AutopilotEmulator):
            return np.array(autopilot.commanded)
        return self.body.commanded

    # ------------------------------------------------------------------ from outside

    def fault(self, fault: Fault) -> None:
        """Trigger a fault.

        Raises
        ------
        ConfigError
            If the robot does not have its device, or cannot stand where it is carried.
        """
        if isinstance(fault, Stall):
            self._stall(fault)
        elif isinstance(fault, Carry):
            self.body.put_down(*(fault.place or self.body.world.robot.start[:2]))
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

    def _line_fault(self, line: Line, fault: LineNoise | Delay | Unplug, until: float) -> None:
        if isinstance(fault, LineNoise):
            line.noise(fault.rate, fault.kind, until)
        elif isinstance(fault, Delay):
            line.hold(until)
        else:
            line.unplug(until)

    def pose(self) -> Array:
        """Return the true pose (3,); from any thread."""
        return self.body.pose

    def truth(self, since: float = 0.0) -> dict[str, Any]:
        """Return the pose of the robot, the speeds of its motors, and the commanded speeds.

        Times are on the computer's monotonic clock (s), which all its processes share; `commands` are
        [time, left, right], m/s, after `since`, with the time at which each took effect.
        """
        body = self.body
        return {
            "monotonic": self._origin + body.time,
            "time": body.time,
            "pose": body.pose.tolist(),
            "twist": body.twist.tolist(),
            "motors": body.motors.tolist(),
            "commanded": self._commanded_speeds().tolist(),
            "stalled": sorted(self._blocked),
            "commands": [entry for entry in self._commands if entry[0] > since],
        }

    def status(self) -> dict[str, Any]:
        """Return lateness and CPU time, s, and the counters of the lines."""
        return {
            **self._lateness.summary(),
            "cpu": time.process_time(),
            "lines": {name: dict(line.counts) for name, line in self._lines.items()},
        }

    def close(self) -> None:
        """Close all ports."""
        for line in self._lines.values():
            line.close()
        if self._camera is not None:
            self._camera.close()
