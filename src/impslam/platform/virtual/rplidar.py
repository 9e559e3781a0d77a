"""The virtual RPLidar: requests in, descriptors, nodes and capsules out, without port or clock."""

from __future__ import annotations

import math
from functools import reduce
from operator import xor

import numpy as np

from impslam.platform.devices.rplidar_protocol import (
    CAPSULE,
    DESCRIPTORS,
    NODE,
    SAMPLES,
    UART_BITS,
    Command,
)
from impslam.platform.virtual.base import Surroundings
from impslam.simulation.robot import Lidar
from impslam.types import Array

BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\n"  # sent at a boot
QUALITY = 15  # of an echo, as A1 reports it

# A1M8 at 10 Hz: 4 kHz in capsules, every second of them as single nodes; clockwise from the front.
A1 = Lidar(
    beams=400,
    angle_min=0.0,
    angle_step=-2.0 * math.pi / 400,
    beam_time=1.0 / 4000.0,
    rate=10.0,
    range_min=0.15,
    range_max=12.0,
)


class RPLidarEmulator:
    """An RPLidar as seen from its port.

    Measurements are sent with a `latency` of one turn, since `surroundings` gives whole turns; a real
    one sends them at once.

    Parameters
    ----------
    surroundings : ranges of the beams of a turn, evenly spaced, clockwise from the front
    lidar : number of beams and rate, as of `surroundings`
    model : code of the model in INFO: 0x18 A1, 0x28 A2, 0x31 A3
    baud : bit rate of the line, which delays measurements
    """

    def __init__(
        self,
        surroundings: Surroundings,
        lidar: Lidar = A1,
        model: int = 0x18,
        baud: int = 115200,
    ) -> None:
        self._surroundings, self._lidar, self._model, self._baud = surroundings, lidar, model, baud
        self.latency = 1.0 / lidar.rate
        self.error_code = 0  # the manufacturer's code of an error, until a reset
        self._reset()

    def _reset(self) -> None:
        self._input, self._output = bytearray(), bytearray()
        self._scan: Command | None = None
        self._started_at = 0.0
        self._sent = 0
        self._turns: dict[int, Array] = {}
        self.motor: int | None = None  # PWM as set, None: never

    def reboot(self, time: float) -> None:
        """Reset everything, as after a short power failure."""
        self._reset()
        self._output += BANNER

    def receive(self, data: bytes, time: float) -> None:
        """Process bytes from the host, in pieces of any size."""
        self._input += data
        while (begin := self._input.find(b"\xa5")) >= 0:
            del self._input[:begin]
            end = self._request_end()
            if end is None:
                return
            packet = bytes(self._input[:end])
            if end > 2 and reduce(xor, packet):
                del self._input[:1]  # its sum is wrong
                continue
            del self._input[:end]
            self._execute(packet[1], packet[3:-1], time)
        self._input.clear()

    def _request_end(self) -> int | None:
        """Return the end of the request at the start of the input; None if it is incomplete."""
        if len(self._input) < 2:
            return None
        if self._input[1] < 0x80:
            return 2
        if len(self._input) < 3 or len(self._input) < 4 + self._input[2]:
            return None
        return 4 + self._input[2]

    def _execute(self, command: int, payload: bytes, time: float) -> None:
        if command == Command.STOP:
            self._scan = None
        elif command == Command.RESET:
            self.error_code = 0
            self.reboot(time)
        elif command in {Command.SCAN, Command.FORCE, Command.EXPRESS}:
            self._begin(Command.EXPRESS if command == Command.EXPRESS else Command.SCAN, time)
        elif command == Command.INFO and self._scan is None:
            firmware, hardware = bytes((29, 1)), bytes((7,))
            self._answer(Command.INFO, bytes((self._model,)) + firmware + hardware + bytes(16))
        elif command == Command.HEALTH and self._scan is None:
            status = bytes((2 if self.error_code else 0,)) + self.error_code.to_bytes(2, "little")
            self._answer(Command.HEALTH, status)
        elif command == Command.PWM and len(payload) == 2:
            self.motor = int.from_bytes(payload, "little")

    def _answer(self, command: Command, data: bytes) -> None:
        self._output += DESCRIPTORS[command] + data

    def _begin(self, scan: Command, time: float) -> None:
        if self.error_code or self.motor == 0:
            return
        self._answer(scan, b"")
        self._scan, self._started_at, self._sent = scan, time, 0
        self._turns.clear()

    def due(self, time: float) -> bytes:
        """Return the bytes sent between the last call and `time`."""
        if self._scan is not None:
            self._measure(time - self._started_at)
        data = bytes(self._output)
        self._output.clear()
        return data

    def _measure(self, time: float) -> None:
        """Output all complete measurements at a time, s after the start of the scan."""
        express = self._scan == Command.EXPRESS
        beams = SAMPLES if express else 2
        on_line = UART_BITS * (CAPSULE if express else NODE) / self._baud
        each = beams / (self._lidar.beams * self._lidar.rate)
        whole = math.floor((time - self.latency - on_line) / each + 1e-9)
        for number in range(self._sent, whole):
            self._output += (self._capsule if express else self._node)(number * beams)
        self._sent = max(self._sent, whole)

    def _range(self, beam: int) -> float:
        """Return the range of a beam, counted from the start of the scan; 0: no echo."""
        turn, place = divmod(beam, self._lidar.beams)
        if turn not in self._turns:
            self._turns = {k: v for k, v in self._turns.items() if k >= turn - 1}
            self._turns[turn] = self._surroundings.ranges(
                self._started_at + turn / self._lidar.rate
            )
        value = float(self._turns[turn][place])
        return value if math.isfinite(value) else 0.0

    def _node(self, beam: int) -> bytes:
        place = beam % self._lidar.beams
        value = self._range(beam)
        start = 1 if place == 0 else 2
        angle = round(place / self._lidar.beams * 360.0 * 64.0) << 1 | 1
        distance = min(round(value * 4000.0), 0xFFFF)
        head = start | (QUALITY << 2 if value > 0.0 else 0)
        return bytes((head,)) + angle.to_bytes(2, "little") + distance.to_bytes(2, "little")

    def _capsule(self, beam: int) -> bytes:
        values = [self._range(beam + k) for k in range(SAMPLES)]
        words = np.minimum(np.round(np.array(values) * 1000.0), 0x3FFF).astype("<u2") << 2
        cabins = np.zeros((SAMPLES // 2, 5), np.uint8)
        cabins[:, :4] = words.view(np.uint8).reshape(-1, 4)
        place = beam % self._lidar.beams
        angle = round(place / self._lidar.beams * 360.0 * 64.0) | (0x8000 if beam == 0 else 0)
        body = angle.to_bytes(2, "little") + cabins.tobytes()
        check = reduce(xor, body)
        return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + body
