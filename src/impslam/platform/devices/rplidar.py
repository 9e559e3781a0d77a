"""Driver of the RPLidar A series (A1, A2, A3), lidars without a clock."""

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
    UART_BITS,
    Answer,
    Command,
    Condition,
    Info,
    Nodes,
    request,
)
from impslam.platform.devices.rplidar_scans import NodeClock, Revolution, Turns, laser_scan

if TYPE_CHECKING:
    import serial

ANSWER_TIMEOUT = 1.0  # s; an answer takes some ms, more while a scan is ending
SETTLING_TIME = 0.05  # s after STOP in which a stream still arrives (the manual specifies 1 ms)
BOOT_TIME = 2.0  # s until it answers again after a reset
SPIN_UP_TIME = 4.0  # s until the motor is fast enough for the first measurement


class RplidarModel(NamedTuple):
    """Data of a series: limits in m, and whether the host controls its motor."""

    name: str
    range_min: float
    range_max: float
    motor: bool


# Data sheets A1M8 rev. 3.0, A2M8 rev. 2.5 and A3M1 rev. 1.0; for white objects.
MODELS = {
    1: RplidarModel("A1", 0.15, 12.0, False),
    2: RplidarModel("A2", 0.2, 12.0, True),
    3: RplidarModel("A3", 0.2, 25.0, True),
}


class _Link:
    """An open port with its parser."""

    def __init__(self, port: serial.SerialBase, stopping: threading.Event) -> None:
        self.port, self.parser, self._stopping = port, Parser(), stopping

    def send(self, command: Command, payload: bytes = b"") -> None:
        write_all(self.port, request(command, payload))

    def receive(self) -> list[Answer | Nodes]:
        """Return received answers and nodes, after a short wait if there are none."""
        return self.parser.feed(read_some(self.port))

    def query(self, command: Command) -> bytes | None:
        """Send a command and return its answer, None if there is none."""
        self.parser.reset()
        self.send(command)
        end = time.monotonic() + ANSWER_TIMEOUT
        while time.monotonic() < end and not self._stopping.is_set():
            for part in self.receive():
                if isinstance(part, Answer) and part.command == command:
                    return part.data
        return None

    def stop_scan(self) -> None:
        """End a scan and discard what is still on the line."""
        self.send(Command.STOP)
        end = time.monotonic() + SETTLING_TIME
        while time.monotonic() < end:
            read_some(self.port, SETTLING_TIME)

    def set_motor(self, model: RplidarModel | None, pwm: int) -> None:
        """Set the motor by PWM, if the model has it, and by the adapter's DTR (low: it turns)."""
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
    pwm: int = parameter(660, "1", "motor duty of A2 and A3, of 1023; 660: 10 Hz", ge=0, le=1023)
    latency: float = parameter(
        0.0, "s", "delay from measuring to sending, without transmission", ge=0
    )
    range_max: float = parameter(
        0.0, "m", "longer ranges are invalid; 0: by the model's data sheet", ge=0
    )

    def _serve(self) -> None:
        with opened(self.port, self.baud) as port:
            link, model = _Link(port, self._stopping), None
            try:
                model = self._identify(link)
                self._measure(link, model)
            except DeviceError:
                if not self._stopping.is_set():
                    raise
            finally:
                with contextlib.suppress(DeviceError):  # it may be gone
                    link.send(Command.STOP)
                    link.set_motor(model, 0)

    def _identify(self, link: _Link) -> RplidarModel:
        """Query model and health; reset the lidar if it reports an error."""
        link.stop_scan()
        data = link.query(Command.INFO)
        if data is None:
            raise DeviceError(
                f"{self.port}: no RPLidar answers; check its supply and baud ({self.baud})"
            )
        info = Info.parse(data)
        unknown = RplidarModel(f"of unknown model 0x{info.model:02X}", math.nan, math.nan, True)
        model = MODELS.get(info.model >> 4, unknown)
        self._check_health(link)
        major, minor = info.firmware
        self._ready(f"RPLidar {model.name}, firmware {major}.{minor:02}, serial {info.serial}")
        return model

    def _check_health(self, link: _Link) -> None:
        """Query the health, and reset the lidar once if it reports an error."""
        condition = self._query_condition(link)
        if condition.status == 2:
            self._count("reset")
            link.send(Command.RESET)
            self._stopping.wait(BOOT_TIME)
            condition = self._query_condition(link)
        if condition.status == 2:
            raise DeviceError(
                f"{self.port}: the RPLidar reports the error 0x{condition.code:04X}; "
                "free its head, then unplug it and plug it in again"
            )
        if condition.status == 1:
            self._notify("warning", f"reports the warning 0x{condition.code:04X}; it may fail soon")

    def _query_condition(self, link: _Link) -> Condition:
        data = link.query(Command.HEALTH)
        if data is None:
            raise DeviceError(
                f"{self.port}: the RPLidar does not answer any more; unplug it and plug it in again"
            )
        return Condition.parse(data)

    def _measure(self, link: _Link, model: RplidarModel) -> None:
        """Start the scan and deliver every turn until the end."""
        link.set_motor(model, self.pwm)
        link.parser.reset()
        express = self.mode == "express"
        link.send(*((Command.EXPRESS, bytes(5)) if express else (Command.SCAN,)))
        on_line = UART_BITS * (CAPSULE if express else NODE) / self.baud
        clock, turns = NodeClock(), Turns()
        until, counted = now() + SPIN_UP_TIME, 0
        while not self._stopping.is_set():
            parts = link.receive()
            arrived = now()
            clock.observe(link.parser.received, arrived - on_line - self.latency)
            for nodes in parts:
                if isinstance(nodes, Nodes):
                    until = arrived + self.timeout
                    for turn in turns.add(nodes):
                        self._deliver_turn(turn, clock, model, arrived)
            counted = self._update_counts(link.parser, turns, counted)
            if arrived > until:
                raise DeviceError(
                    f"{self.port}: the RPLidar sends no measurements; check that its head turns"
                    + (', and set mode = "standard" if its firmware is old' if express else "")
                )

    def _deliver_turn(
        self, turn: Revolution, clock: NodeClock, model: RplidarModel, arrived: float
    ) -> None:
        fitted = clock.fit()
        if fitted is None:
            self._count("before the clock")
            return
        begin, period = fitted
        limits = model.range_min, self.range_max or model.range_max
        self._deliver(laser_scan(turn, begin + period * turn.first, period, limits), arrived)

    def _update_counts(self, parser: Parser, turns: Turns, counted: int) -> int:
        """Count what was lost since the last time."""
        for what, number in parser.counts.items():
            self._count(what, number)
        parser.counts.clear()
        if turns.broken > counted:
            self._count("broken turns", turns.broken - counted)
        return turns.broken
