"""The payloads of the autopilot's frames (docs/autopilot-protocol.md); little endian.

Numbers have the units of the protocol; the driver converts them to SI units. Payloads of a wrong size,
and values out of range, raise a `MessageError`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import astuple, dataclass
from enum import IntEnum, IntFlag
from typing import Any, ClassVar

from impslam.errors import MessageError

ADC_STEPS = 4096  # 12 bits
ADC_VOLTS = 5.0  # V of the full scale, one turn of an MA3
_FOREVER = 10**15  # us, 31 years: longer than any clock has run
_TOP_SPEED = 10_000  # mm/s
_TEMPERATURES = range(-4000, 12501)  # 0.01 degC, the range of such sensors
_HUMIDITIES = range(10_001)  # 0.01 %


class FrameType(IntEnum):
    """Types of frames."""

    HELLO = 0x01
    SENSORS = 0x02
    ACK = 0x03
    DRIVE = 0x10
    STOP = 0x11
    RELEASE = 0x12
    SET_TIME = 0x13


FROM_AUTOPILOT = frozenset({FrameType.HELLO, FrameType.SENSORS, FrameType.ACK})
COMMANDS = frozenset({FrameType.DRIVE, FrameType.STOP, FrameType.RELEASE, FrameType.SET_TIME})


class Flag(IntFlag):
    """States of the autopilot, in every `Sensors`."""

    STOPPED = 1
    DEAD_MAN = 2
    STALL_LEFT = 4
    STALL_RIGHT = 8
    LOW_SUPPLY = 16


class Reset(IntEnum):
    """Why the autopilot restarted."""

    POWER = 0
    BROWN_OUT = 1
    WATCHDOG = 2
    SOFTWARE = 3
    PIN = 4
    UNKNOWN = 5


class Result(IntEnum):
    """The result of a command."""

    DONE = 0
    STOPPED = 1
    MALFORMED = 2
    UNKNOWN = 3


def _unpack(layout: struct.Struct, what: str, payload: bytes) -> tuple[Any, ...]:
    if len(payload) != layout.size:
        raise MessageError(f"{what} of {len(payload)} bytes; it has {layout.size}")
    return layout.unpack(payload)


def _require(fits: bool, what: str, value: object) -> None:
    if not fits:
        raise MessageError(f"{what} of {value!r} is impossible; check the firmware")


@dataclass(frozen=True, slots=True)
class _Payload:
    """The payload of a frame, with fields in the order of the layout."""

    LAYOUT: ClassVar[struct.Struct]

    def pack(self) -> bytes:
        """Return the payload."""
        return self.LAYOUT.pack(*astuple(self))


@dataclass(frozen=True, slots=True)
class Hello(_Payload):
    """Description of the autopilot, sent at its start, every second, and after each `SetTime`.

    Scales are SI units per step: `gyro` rad/s, `accelerometer` and `accelerometer_2` m/s^2,
    `magnetometer` T. `clock` is in us since the start; `host_offset` is the host's clock minus its
    own, us, as of the last `SetTime`, 0 before it.
    """

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IBBBffffQq")

    boots: int
    major: int
    minor: int
    reset: Reset
    gyro: float
    accelerometer: float
    accelerometer_2: float
    magnetometer: float
    clock: int
    host_offset: int

    @classmethod
    def parse(cls, payload: bytes) -> Hello:
        """Read a payload; see the module for what is refused."""
        boots, major, minor, reset, *rest = _unpack(cls.LAYOUT, "HELLO", payload)
        *scales, clock, _ = rest
        _require(reset in set(Reset), "a reset reason", reset)
        for scale in scales:
            _require(math.isfinite(scale) and 0.0 < scale < 1.0, "a scale", scale)
        _require(clock < _FOREVER, "a clock", clock)
        return cls(boots, major, minor, Reset(reset), *rest)


@dataclass(frozen=True, slots=True)
class Sensors(_Payload):
    """Readings of the sensors at `clock` (us since the start), sent 100 times a second.

    `counts` are the accumulators of the left and the right encoder, from 0 at the start, 4096 a
    turn, growing as the wheel rolls forward, wrapping at 32 bits; `voltages` their absolute
    readings in steps of 5 V / 4096. `gyro`, `accelerometer`, `accelerometer_2` and `magnetometer`
    are (x, y, z) in steps of `Hello`'s scales. `temperature` is in 0.01 degC, `humidity` in 0.01 %.
    `applied` is the sequence number of the last command that was done, at `applied_clock`; both
    are 0 before the first.
    """

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Q2i2H3h3h3h3hhHHHQ")

    clock: int
    counts: tuple[int, int]
    voltages: tuple[int, int]
    gyro: tuple[int, int, int]
    accelerometer: tuple[int, int, int]
    accelerometer_2: tuple[int, int, int]
    magnetometer: tuple[int, int, int]
    temperature: int
    humidity: int
    flags: Flag
    applied: int
    applied_clock: int

    def pack(self) -> bytes:
        """Return the payload."""
        return self.LAYOUT.pack(
            self.clock,
            *self.counts,
            *self.voltages,
            *self.gyro,
            *self.accelerometer,
            *self.accelerometer_2,
            *self.magnetometer,
            self.temperature,
            self.humidity,
            self.flags,
            self.applied,
            self.applied_clock,
        )

    @classmethod
    def parse(cls, payload: bytes) -> Sensors:
        """Read a payload; see the module for what is refused."""
        v = _unpack(cls.LAYOUT, "SENSORS", payload)
        temperature, humidity, flags, applied, applied_clock = v[17:]
        _require(v[0] < _FOREVER, "a clock", v[0])
        _require(max(v[3], v[4]) < ADC_STEPS, "an encoder's reading", v[3:5])
        _require(temperature in _TEMPERATURES, "a temperature", temperature)
        _require(humidity in _HUMIDITIES, "a humidity", humidity)
        _require(not flags & ~sum(Flag), "a set of flags", flags)
        _require(applied_clock <= v[0], "a command's moment", applied_clock)
        return cls(
            clock=v[0],
            counts=(v[1], v[2]),
            voltages=(v[3], v[4]),
            gyro=(v[5], v[6], v[7]),
            accelerometer=(v[8], v[9], v[10]),
            accelerometer_2=(v[11], v[12], v[13]),
            magnetometer=(v[14], v[15], v[16]),
            temperature=temperature,
            humidity=humidity,
            flags=Flag(flags),
            applied=applied,
            applied_clock=applied_clock,
        )


@dataclass(frozen=True, slots=True)
class Ack(_Payload):
    """The answer to a command: its type and sequence number, the result, and the time, us."""

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHQ")

    command: int
    result: Result
    sequence: int
    clock: int

    @classmethod
    def parse(cls, payload: bytes) -> Ack:
        """Read a payload; see the module for what is refused."""
        command, result, sequence, clock = _unpack(cls.LAYOUT, "ACK", payload)
        _require(result in set(Result), "a result", result)
        _require(clock < _FOREVER, "a clock", clock)
        return cls(command, Result(result), sequence, clock)


@dataclass(frozen=True, slots=True)
class DriveCommand(_Payload):
    """Surface speeds of the driven wheels of each side, mm/s, forward positive."""

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<hh")

    left: int
    right: int

    @classmethod
    def parse(cls, payload: bytes) -> DriveCommand:
        """Read a payload; see the module for what is refused."""
        left, right = _unpack(cls.LAYOUT, "DRIVE", payload)
        _require(max(abs(left), abs(right)) <= _TOP_SPEED, "a speed", (left, right))
        return cls(left, right)


@dataclass(frozen=True, slots=True)
class SetTime(_Payload):
    """The host's clock at the sending of the frame, us since 1970."""

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Q")

    host: int

    @classmethod
    def parse(cls, payload: bytes) -> SetTime:
        """Read a payload; see the module for what is refused."""
        (host,) = _unpack(cls.LAYOUT, "SET_TIME", payload)
        _require(host < 10 * _FOREVER, "a time", host)
        return cls(host)


def parse_empty(what: str, payload: bytes) -> None:
    """Refuse a payload of STOP or RELEASE, which have none."""
    _unpack(struct.Struct(""), what, payload)
