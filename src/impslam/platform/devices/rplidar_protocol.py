"""What an RPLidar of the A series says: requests, answers, and streams of measured nodes.

Interface Protocol and Application Notes (Slamtec). A request is A5, a command, and where it has a
payload also its length, itself, and the XOR of all before it. Every answer begins with a descriptor
of 7 bytes; those of a scan never end.

- SCAN: nodes of 5 bytes. One bit and its complement tell the start of a turn, one bit is always 1,
  angles lie below 360 deg; nothing else protects them. A random node passes with a probability of
  1/2 * 1/2 * 23040/32768 = 0.18, and of 0.015 where its angle must follow from the one before. A
  bit that flips in a distance or in the lower bits of an angle cannot be seen.
- EXPRESS: capsules of 32 measurements with an XOR of 8 bits and two sync nibbles: every single
  flipped bit is seen, two of them in seven of eight cases, random bytes but once in 65536.

Angles here are the device's own: clockwise, 0 at its front, in rad.
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

NODE = 5  # bytes
CAPSULE = 84  # bytes
SAMPLES = 32  # in a capsule
FOLLOWS = math.radians(15.0)  # from node to node: 15 Hz at 2 kHz is 2.7 deg, near targets shift 8

SYNC = b"\xa5\x5a"
LENGTH = 7  # of a descriptor


class Command(IntEnum):
    """What can be asked of it."""

    STOP = 0x25
    RESET = 0x40
    SCAN = 0x20
    FORCE = 0x21
    INFO = 0x50
    HEALTH = 0x52
    EXPRESS = 0x82
    PWM = 0xF0


class Shape(NamedTuple):
    """What follows a descriptor: of this many bytes, once or for ever."""

    command: Command
    size: int
    stream: bool


# Length in 30 bits and mode (1: for ever) in 2, little-endian, then the type.
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
    """Return the bytes that ask for something."""
    if not payload:
        return bytes((0xA5, command))
    head = bytes((0xA5, command, len(payload))) + payload
    return head + bytes((reduce(xor, head),))


@dataclass(frozen=True, slots=True)
class Answer:
    """What came once for a command, without its descriptor."""

    command: Command
    data: bytes


@dataclass(frozen=True, slots=True)
class Info:
    """Who it is: `model` has the series in its upper and the version in its lower four bits."""

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
    """How it says it is: `status` 0 good, 1 warning, 2 error, and the maker's own code."""

    status: int
    code: int

    @staticmethod
    def parse(data: bytes) -> Condition:
        """Read the 3 bytes of an answer to HEALTH."""
        return Condition(*struct.unpack("<BH", data))


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Measurements that follow each other without a gap.

    Attributes
    ----------
    first : number of the first one, counted by the bytes since the stream began
    starts : (n,) bool, a turn begins with this one
    angles : (n,) rad in [0, 2 pi), clockwise
    ranges : (n,) m, 0 where nothing was measured
    qualities : (n,) 0 to 63, None in capsules
    """

    first: int
    starts: Mask
    angles: Array
    ranges: Array
    qualities: Array | None


def sound(rows: Bytes) -> Mask:
    """Tell which rows (n, 5) may be nodes: S is not not-S, check bit 1, angle below a turn."""
    return np.asarray(
        ((rows[:, 0] ^ rows[:, 0] >> 1) & 1 == 1)
        & (rows[:, 1] & 1 == 1)
        & (angles_of(rows) < 2 * math.pi)
    )


def angles_of(rows: Bytes) -> Array:
    """Return the angles of nodes (n, 5), clockwise, rad."""
    raw = (rows[:, 1].astype(np.int64) | rows[:, 2].astype(np.int64) << 8) >> 1
    return np.asarray(np.radians(raw / 64.0))


def follow(angles: Array) -> Mask:
    """Tell which angles along the first axis follow from the ones before them."""
    return np.asarray(np.abs(wrap(np.diff(angles, axis=0))) <= FOLLOWS)


def node_values(first: int, rows: Bytes) -> Nodes:
    """Return the measurements of sound nodes (n, 5)."""
    ranges = rows[:, 3].astype(np.int64) | rows[:, 4].astype(np.int64) << 8
    return Nodes(
        first,
        np.asarray(rows[:, 0] & 1 == 1),
        angles_of(rows),
        ranges / 4000.0,
        (rows[:, 0] >> 2).astype(np.float64),
    )


def capsule_is_sound(row: Bytes) -> bool:
    """Tell whether 84 bytes are a capsule: sync nibbles A and 5, and their XOR."""
    told = (row[0] & 0xF) | (row[1] & 0xF) << 4
    return bool(
        row[0] >> 4 == 0xA and row[1] >> 4 == 0x5 and np.bitwise_xor.reduce(row[2:]) == told
    )


def capsule_begin(row: Bytes) -> tuple[bool, float]:
    """Return whether a capsule is the first of its stream, and the angle at which it begins."""
    raw = int(row[2]) | int(row[3]) << 8
    return raw >= 0x8000, math.radians((raw & 0x7FFF) / 64.0) % (2 * math.pi)


def capsule_values(first: int, row: Bytes, begin: float, span: float) -> Nodes:
    """Return the measurements of a capsule that spans an angle.

    Sixteen cabins of 5 bytes: two distances in mm in the upper 14 bits of a word each, whose lower
    two are the upper ones of an angle in 1/8 deg by which the measurement lies before its place on
    the even spacing (the triangle of laser and camera); its other four bits are in the fifth byte.
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
