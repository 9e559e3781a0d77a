"""The protocol of the RPLidar A series: requests, answers, and streams of measured nodes.

Interface Protocol and Application Notes (Slamtec). A request is A5 and a command; a payload is preceded
by its length and followed by the XOR of all before it. Every answer begins with a descriptor of 7 bytes;
that of a scan never ends.

- SCAN: nodes of 5 bytes. One bit and its complement mark the start of a turn, one bit is always 1,
  angles are below 360 deg; nothing else protects them. A random node passes with a probability of
  1/2 * 1/2 * 23040/32768 = 0.18, and of 0.015 if its angle must be consistent with the one before. A
  flipped bit of a distance, or in the lower bits of an angle, cannot be detected.
- EXPRESS: capsules of 32 measurements with an XOR of 8 bits and two sync nibbles: every single flipped
  bit is detected, two of them in seven of eight cases, random bytes all but once in 65536.

Angles here are those of the device: clockwise, 0 at its front, rad.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.geometry.angles import wrap
from impslam.types import Array, Mask

Bytes: TypeAlias = npt.NDArray[np.uint8]

UART_BITS = 10  # bits on the line per byte: start, 8, stop
NODE = 5  # bytes
CAPSULE = 84  # bytes
SAMPLES = 32  # in a capsule
MAX_STEP = math.radians(15.0)  # between nodes: 15 Hz at 2 kHz is 2.7 deg; near targets shift by 8

SYNC = b"\xa5\x5a"
LENGTH = 7  # of a descriptor


class Command(IntEnum):
    """Commands of a request."""

    STOP = 0x25
    RESET = 0x40
    SCAN = 0x20
    FORCE = 0x21
    INFO = 0x50
    HEALTH = 0x52
    EXPRESS = 0x82
    PWM = 0xF0


class Shape(NamedTuple):
    """The data after a descriptor: its size in bytes, sent once or as an endless stream."""

    command: Command
    size: int
    stream: bool


# Length in 30 bits and mode (1: stream) in 2, little-endian, then the type.
SHAPES = {
    SYNC + struct.pack("<IB", shape.size | shape.stream << 30, kind): shape
    for kind, shape in {
        0x04: Shape(Command.INFO, 20, False),
        0x06: Shape(Command.HEALTH, 3, False),
        0x81: Shape(Command.SCAN, NODE, True),
        0x82: Shape(Command.EXPRESS, CAPSULE, True),
    }.items()
}
DESCRIPTORS = {shape.command: head for head, shape in SHAPES.items()}


def request(command: Command, payload: bytes = b"") -> bytes:
    """Return the bytes of a request."""
    if not payload:
        return bytes((0xA5, command))
    head = bytes((0xA5, command, len(payload))) + payload
    return head + bytes((reduce(xor, head),))


@dataclass(frozen=True, slots=True)
class Answer:
    """A single answer to a command, without its descriptor."""

    command: Command
    data: bytes


@dataclass(frozen=True, slots=True)
class Info:
    """Device information: `model` has the series in its upper four bits, the version in the lower."""

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial: str

    @staticmethod
    def parse(data: bytes) -> Info:
        """Read the 20 bytes of an answer to INFO."""
        model, minor, major, hardware, serial = struct.unpack("<4B16s", data)
        return Info(model, (major, minor), hardware, serial.hex().upper())


@dataclass(frozen=True, slots=True)
class Condition:
    """Device health: `status` 0 good, 1 warning, 2 error, and the manufacturer's code."""

    status: int
    code: int

    @staticmethod
    def parse(data: bytes) -> Condition:
        """Read the 3 bytes of an answer to HEALTH."""
        return Condition(*struct.unpack("<BH", data))


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Consecutive measurements without a gap.

    Attributes
    ----------
    first : number of the first one, counted by the bytes since the start of the stream
    starts : (n,) bool, whether a turn begins
    angles : (n,) rad in [0, 2 pi), clockwise
    ranges : (n,) m, 0 if nothing was measured
    qualities : (n,) 0 to 63, None in capsules
    """

    first: int
    starts: Mask
    angles: Array
    ranges: Array
    qualities: Array | None


def is_valid_node(rows: Bytes) -> Mask:
    """Return which rows (n, 5) may be nodes: S differs from not-S, check bit 1, angle below a turn."""
    return np.asarray(
        ((rows[:, 0] ^ rows[:, 0] >> 1) & 1 == 1)
        & (rows[:, 1] & 1 == 1)
        & (angles_of(rows) < 2 * math.pi)
    )


def angles_of(rows: Bytes) -> Array:
    """Return the angles of nodes (n, 5), clockwise, rad."""
    raw = (rows[:, 1].astype(np.int64) | rows[:, 2].astype(np.int64) << 8) >> 1
    return np.asarray(np.radians(raw / 64.0))


def are_consecutive(angles: Array) -> Mask:
    """Return which angles along the first axis are consistent with the ones before them."""
    return np.asarray(np.abs(wrap(np.diff(angles, axis=0))) <= MAX_STEP)


def node_values(first: int, rows: Bytes) -> Nodes:
    """Return the measurements of valid nodes (n, 5)."""
    ranges = rows[:, 3].astype(np.int64) | rows[:, 4].astype(np.int64) << 8
    return Nodes(
        first,
        np.asarray(rows[:, 0] & 1 == 1),
        angles_of(rows),
        ranges / 4000.0,
        (rows[:, 0] >> 2).astype(np.float64),
    )


def is_valid_capsule(row: Bytes) -> bool:
    """Return whether 84 bytes are a capsule: sync nibbles A and 5, and a correct XOR."""
    checksum = (row[0] & 0xF) | (row[1] & 0xF) << 4
    return bool(
        row[0] >> 4 == 0xA and row[1] >> 4 == 0x5 and np.bitwise_xor.reduce(row[2:]) == checksum
    )


def capsule_begin(row: Bytes) -> tuple[bool, float]:
    """Return whether a capsule is the first of its stream, and its start angle."""
    raw = int(row[2]) | int(row[3]) << 8
    return raw >= 0x8000, math.radians((raw & 0x7FFF) / 64.0) % (2 * math.pi)


def capsule_values(first: int, row: Bytes, begin: float, span: float) -> Nodes:
    """Return the measurements of a capsule that spans an angle.

    A capsule has sixteen cabins of 5 bytes: two words, each with a distance in mm in its upper 14 bits,
    and four more bits for each in the fifth byte. With the lower two bits of the word as the upper ones,
    they are the angle in 1/8 deg by which the measurement is before its evenly spaced position (an
    effect of triangulation).
    """
    cabins = row[4:].reshape(-1, 5).astype(np.int64)
    words = cabins[:, 0:4:2] | cabins[:, 1:4:2] << 8  # (16, 2)
    nibbles = np.column_stack([cabins[:, 4] & 0xF, cabins[:, 4] >> 4])
    shifts = np.radians(((words & 3) << 4 | nibbles).ravel() / 8.0)
    even = begin + span / SAMPLES * np.arange(SAMPLES)
    turns = np.floor(even / (2 * math.pi))
    starts = np.diff(turns, prepend=turns[0] if begin >= span / SAMPLES else turns[0] - 1) > 0
    return Nodes(
        first,
        np.asarray(starts, dtype=np.bool_),
        np.asarray((even - shifts) % (2 * math.pi)),
        (words >> 2).ravel() / 1000.0,
        None,
    )
