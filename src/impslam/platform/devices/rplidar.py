"""RPLidar of the A series (A1, A2, A3): a lidar without a clock, behind the role of devices."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import TYPE_CHECKING, Literal, NamedTuple

from impslam.component import parameter, register
from impslam.platform.devices.base import Device, DeviceError, now
from impslam.platform.devices.port import opened, read_some, write_all
from impslam.platform.devices.rplidar_parser import Parser
from impslam.platform.devices.rplidar_protocol import (
    CAPSULE,
    NODE,
    Answer,
    Command,
    Condition,
    Info,
    Nodes,
    request,
)
from impslam.platform.devices.rplidar_scans import NodeClock, Turn, Turns, laser_scan

if TYPE_CHECKING:
    import serial

ANSWER = 1.0  # s to wait for an answer; it takes some ms, more while a scan is ending
SETTLE = 0.05  # s after STOP in which a stream still comes (the maker asks for 1 ms)
BOOT = 2.0  # s until it answers again after a reset
SPIN_UP = 4.0  # s until the motor is fast enough for the first measurement
UART = 10  # bits on the line for a byte: start, 8, stop


class Model(NamedTuple):
    """What the data sheets say of a series: limits in m, and whether the host sets its motor."""

    name: str
    range_min: float
    range_max: float
    motor: bool


# Data sheets A1M8 rev. 3.0, A2M8 rev. 2.5 and A3M1 rev. 1.0; on white things.
MODELS = {
    1: Model("A1", 0.15, 12.0, False),
    2: Model("A2", 0.2, 12.0, True),
    3: Model("A3", 0.2, 25.0, True),
}


class _Link:
    """An open port with a parser behind it."""

    def __init__(self, port: serial.SerialBase, stopping: threading.Event) -> None:
        self.port, self.parser, self._stopping = port, Parser(), stopping

    def send(self, command: Command, payload: bytes = b"") -> None:
        write_all(self.port, request(command, payload))

    def listen(self) -> list[Answer | Nodes]:
        """Return what has come, after some ms if nothing has."""
        return self.parser.feed(read_some(self.port))

    def ask(self, command: Command) -> bytes | None:
        """Return the answer to a command; None if there is none."""
        self.parser.reset()
        self.send(command)
        end = time.monotonic() + ANSWER
        while time.monotonic() < end and not self._stopping.is_set():
            for part in self.listen():
                if isinstance(part, Answer) and part.command == command:
                    return part.data
        return None

    def hush(self) -> None:
        """End a scan and throw away what is still on the line."""
        self.send(Command.STOP)
        end = time.monotonic() + SETTLE
        while time.monotonic() < end:
            read_some(self.port, SETTLE)

    def turn(self, model: Model | None, pwm: int) -> None:
        """Set the motor: by PWM where the model has it, and by the adapter's DTR (low: it turns)."""
        with contextlib.suppress(OSError):  # a pseudo-terminal has no such line
            self.port.dtr = pwm == 0
        if model is None or model.motor:
            self.send(Command.PWM, pwm.to_bytes(2, "little"))


@register("rplidar")
class RPLidar(Device):
    """RPLidar A1, A2 or A3 on a serial port."""

    port: str = parameter("/dev/ttyUSB0", "1", 'serial port, or "socket://host:port"')
    baud: int = parameter(115200, "1/s", "115200 for A1 and A2, 256000 for A3", gt=0)
    mode: Literal["express", "standard"] = parameter(
        "express", "1", "express: twice the beams and a checksum; standard: firmware before 1.17"
    )
    pwm: int = parameter(660, "1", "duty of the motor of A2 and A3, of 1023; 660: 10 Hz", ge=0)
    latency: float = parameter(
        0.0, "s", "from a measurement until it is sent, besides its time on the line", ge=0
    )
    range_max: float = parameter(
        0.0, "m", "longer ranges are invalid; 0: by the model's data sheet", ge=0
    )

    def _serve(self) -> None:
        with opened(self.port, self.baud) as port:
            link, model = _Link(port, self._stopping), None
            try:
                model = self._introduce(link)
                self._measure(link, model)
            except DeviceError:
                if not self._stopping.is_set():
                    raise
            finally:
                with contextlib.suppress(DeviceError):  # it may be gone
                    link.send(Command.STOP)
                    link.turn(model, 0)

    def _introduce(self, link: _Link) -> Model:
        """Learn who it is and how it is; reset it if it says that it is ill."""
        link.hush()
        data = link.ask(Command.INFO)
        if data is None:
            raise DeviceError(
                f"{self.port}: no RPLidar answers; check its supply and baud ({self.baud})"
            )
        info = Info.parse(data)
        unknown = Model(f"of unknown model 0x{info.model:02X}", math.nan, math.nan, True)
        model = MODELS.get(info.model >> 4, unknown)
        self._check(link)
        major, minor = info.firmware
        self._ready(f"RPLidar {model.name}, firmware {major}.{minor:02}, serial {info.serial}")
        return model

    def _check(self, link: _Link) -> None:
        """Ask how it is."""
        condition = self._condition(link)
        if condition.status == 2:
            self._count("reset")
            link.send(Command.RESET)
            self._stopping.wait(BOOT)
            condition = self._condition(link)
        if condition.status == 2:
            raise DeviceError(
                f"{self.port}: the RPLidar reports the error 0x{condition.code:04X}; "
                "free its head, and unplug it for a moment"
            )
        if condition.status == 1:
            self._tell("warning", f"reports the warning 0x{condition.code:04X}; it may fail soon")

    def _condition(self, link: _Link) -> Condition:
        data = link.ask(Command.HEALTH)
        if data is None:
            raise DeviceError(f"{self.port}: the RPLidar answers no more; unplug it for a moment")
        return Condition.parse(data)

    def _measure(self, link: _Link, model: Model) -> None:
        """Start the scan and deliver every turn until the end."""
        link.turn(model, self.pwm)
        link.parser.reset()
        express = self.mode == "express"
        link.send(*((Command.EXPRESS, bytes(5)) if express else (Command.SCAN,)))
        on_line = UART * (CAPSULE if express else NODE) / self.baud
        clock, turns = NodeClock(), Turns()
        until, told = now() + SPIN_UP, 0
        while not self._stopping.is_set():
            parts = link.listen()
            arrived = now()
            clock.observe(link.parser.received, arrived - on_line - self.latency)
            for nodes in parts:
                if isinstance(nodes, Nodes):
                    until = arrived + self.patience
                    for turn in turns.add(nodes):
                        self._pass_on(turn, clock, model, arrived)
            told = self._take_counts(link.parser, turns, told)
            if arrived > until:
                raise DeviceError(
                    f"{self.port}: the RPLidar measures nothing; see that its head turns"
                    + (', and set mode = "standard" if its firmware is old' if express else "")
                )

    def _pass_on(self, turn: Turn, clock: NodeClock, model: Model, arrived: float) -> None:
        fitted = clock.fit()
        if fitted is None:
            self._count("before the clock")
            return
        begin, period = fitted
        limits = model.range_min, self.range_max or model.range_max
        self._deliver(laser_scan(turn, begin + period * turn.first, period, limits), arrived)

    def _take_counts(self, parser: Parser, turns: Turns, told: int) -> int:
        """Count what was lost since the last time."""
        for what, number in parser.counts.items():
            self._count(what, number)
        parser.counts.clear()
        if turns.broken > told:
            self._count("broken turns", turns.broken - told)
        return turns.broken
