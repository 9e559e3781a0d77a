"""What an RPLidar of the A series says: requests, answers, and streams of measured nodes.

Interface Protocol and Application Notes (Slamtec). A request is A5, a command, and where it has a
payload also its length, itself, and the XOR of all before it. Every answer begins with a descriptor
of 7 bytes; those of a scan never end.

- SCAN: nodes of 5 bytes. One bit and its complement tell the start of a turn, one bit is always 1,
  angles lie below 360 deg; nothing else protects them. A random node passes with a probability of
  1/2 * 1/2 * 23040/32768 = 0.18. A node is therefore taken only where its angle follows from the
  one before (then 0.015) and `HELD` sound ones follow it, and after a loss only where `CHAIN` of
  them do (6e-7). A bit that flips in a distance or in the lower bits of an angle cannot be seen.
- EXPRESS: capsules of 32 measurements with an XOR of 8 bits and two sync nibbles: every single
  flipped bit is seen, anything else but once in 65536.

Angles here are the device's own: clockwise, 0 at its front, in rad.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.types import Array, Mask

Bytes: TypeAlias = npt.NDArray[np.uint8]

NODE = 5  # bytes
CAPSULE = 84  # bytes
SAMPLES = 32  # in a capsule
CHAIN = 4  # nodes that must follow from each other before a stream is believed
HELD = 2  # nodes that are held back until as many sound ones came after them
FOLLOWS = math.radians(15.0)  # from node to node: 15 Hz at 2 kHz is 2.7 deg, near targets shift 8
SPREAD = 0.25  # relative change of a turn's speed from capsule to capsule; more is a capsule lost
WIDEST = math.radians(120.0)  # of a capsule: 15 Hz at 2 kHz is 86 deg

_SYNC = b"\xa5\x5a"
_LENGTH = 7  # of a descriptor


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
_SHAPES = {
    _SYNC + struct.pack("<IB", shape.size | shape.stream << 30, kind): shape
    for kind, shape in {
        0x04: Shape(Command.INFO, 20, False),
        0x06: Shape(Command.HEALTH, 3, False),
        0x81: Shape(Command.SCAN, NODE, True),
        0x82: Shape(Command.EXPRESS, CAPSULE, True),
    }.items()
}
DESCRIPTORS = {shape.command: head for head, shape in _SHAPES.items()}


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


class Parser:
    """Makes answers and nodes of bytes, however they are cut, spoilt or mixed; never raises.

    `counts` has "corrupt" (nodes that were no nodes, or in capsules that were none) and "gaps"
    (where sound ones did not follow from those before).
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget all bytes and expect an answer."""
        self._buffer = bytearray()
        self._stream: Command | None = None
        self._position = 0  # bytes of the stream that are out of the buffer
        self._last: float | None = None  # angle of the node before, None: must be found anew
        self._capsule: Bytes | None = None  # waits for the next one, which tells where it ends
        self._span = 0.0  # rad, width of the capsule before

    @property
    def received(self) -> int:
        """Number of the measurement after the last one whose bytes are all here."""
        return self._number(self._position + len(self._buffer))

    def feed(self, data: bytes) -> list[Answer | Nodes]:
        """Take bytes and return what they complete."""
        self._buffer += data
        found: list[Answer | Nodes] = []
        if self._stream is None:
            found += self._answers()
        if self._stream == Command.SCAN:
            found += self._nodes()
        elif self._stream == Command.EXPRESS:
            found += self._capsules()
        return found

    def _number(self, position: int) -> int:
        if self._stream == Command.EXPRESS:
            return position // CAPSULE * SAMPLES
        return position // NODE

    # ------------------------------------------------------------------ answers

    def _answers(self) -> list[Answer | Nodes]:
        found: list[Answer | Nodes] = []
        while self._stream is None and (begin := self._buffer.find(_SYNC)) >= 0:
            shape = _SHAPES.get(bytes(self._buffer[begin : begin + _LENGTH]))
            end = begin + _LENGTH + (shape.size if shape and not shape.stream else 0)
            if len(self._buffer) < end:
                break
            if shape is None:
                end = begin + 1
            elif shape.stream:
                self._stream = shape.command
            else:
                found.append(Answer(shape.command, bytes(self._buffer[begin + _LENGTH : end])))
            del self._buffer[:end]
        else:
            if self._stream is None:
                del self._buffer[:-1]  # half of a sync may wait there
        return found

    # ------------------------------------------------------------------ nodes

    def _nodes(self) -> list[Nodes]:
        found: list[Nodes] = []
        while self._last is not None or self._align():
            rows = np.frombuffer(bytes(self._buffer), np.uint8)
            rows = rows[: len(rows) // NODE * NODE].reshape(-1, NODE)
            angles = _angles(rows)
            before = angles if self._last is None else np.append(self._last, angles)
            good = _sound(rows)
            good[len(rows) - len(before) + 1 :] &= _follow(before)
            number = len(rows) if good.all() else int(good.argmin())
            sure = max(number - HELD, 0)
            if sure:
                found.append(_node_values(self._number(self._position), rows[:sure]))
                self._last = float(angles[sure - 1])
                self._drop(NODE * sure)
            if number == len(rows):
                break
            self._last = None
            self._count_lost(NODE * (number - sure))  # half of the last may be another's
            self._drop(NODE * (number - sure))
        return found

    def _align(self) -> bool:
        """Go to where `CHAIN` nodes follow from each other; False if there is no such place yet."""
        data = np.frombuffer(bytes(self._buffer), np.uint8)
        places = len(data) - NODE * CHAIN + 1
        if places <= 0:
            return False
        windows = np.lib.stride_tricks.sliding_window_view(data, NODE)
        sound, angles = _sound(windows), _angles(windows)
        chained = np.ones(places, np.bool_)
        for k in range(CHAIN):
            chained &= sound[NODE * k :][:places]
        for k in range(CHAIN - 1):
            a, b = angles[NODE * k :][:places], angles[NODE * (k + 1) :][:places]
            chained &= _follow(np.stack([a, b]))[0]
        place = int(chained.argmax()) if chained.any() else places
        if place:
            self._count_lost(place)
        elif self._position:
            self.counts["gaps"] += 1
        self._drop(place)
        return bool(place < places)

    def _count_lost(self, number: int) -> None:
        """Count what is skipped; a part of a node or a capsule is one, once."""
        size = CAPSULE if self._stream == Command.EXPRESS else NODE
        begin = self._position + size - 1
        self.counts["corrupt"] += self._number(begin + number) - self._number(begin)

    def _drop(self, number: int) -> None:
        del self._buffer[:number]
        self._position += number

    # ------------------------------------------------------------------ capsules

    def _capsules(self) -> list[Nodes]:
        found: list[Nodes] = []
        while len(self._buffer) >= CAPSULE:
            row = np.frombuffer(bytes(self._buffer[:CAPSULE]), np.uint8)
            if not _capsule_is_sound(row):
                self._seek_capsule()
                continue
            nodes = self._between(row)
            if nodes is not None:
                found.append(nodes)
            self._capsule = row
            self._drop(CAPSULE)
        return found

    def _seek_capsule(self) -> None:
        """Go to the next place where a capsule may begin."""
        if self._capsule is not None:
            self.counts["corrupt"] += SAMPLES  # where it ends will never be known
        self._capsule, self._span = None, 0.0
        data = np.frombuffer(bytes(self._buffer), np.uint8)
        marks = np.flatnonzero((data[1:-1] >> 4 == 0xA) & (data[2:] >> 4 == 0x5)) + 1
        skipped = int(marks[0]) if len(marks) else len(data) - 1
        self._count_lost(skipped)
        self._drop(skipped)

    def _between(self, row: Bytes) -> Nodes | None:
        """Return the measurements of the capsule that waits, now that the next one is known."""
        fresh, angle = _capsule_begin(row)
        if self._capsule is None or fresh:
            return None
        _, begin = _capsule_begin(self._capsule)
        span, before = (angle - begin) % (2 * math.pi), self._span
        self._span = span
        if span > WIDEST or (before and abs(span - before) > SPREAD * before):
            self.counts["gaps"] += 1
            return None
        return _capsule_values(self._number(self._position - CAPSULE), self._capsule, begin, span)


def _sound(rows: Bytes) -> Mask:
    """Tell which rows (n, 5) may be nodes: S is not not-S, check bit 1, angle below a turn."""
    return np.asarray(
        ((rows[:, 0] ^ rows[:, 0] >> 1) & 1 == 1)
        & (rows[:, 1] & 1 == 1)
        & (_angles(rows) < 2 * math.pi)
    )


def _angles(rows: Bytes) -> Array:
    raw = (rows[:, 1].astype(np.int64) | rows[:, 2].astype(np.int64) << 8) >> 1
    return np.asarray(np.radians(raw / 64.0))


def _follow(angles: Array) -> Mask:
    """Tell which angles along the first axis follow from the ones before them."""
    steps = (np.diff(angles, axis=0) + math.pi) % (2 * math.pi) - math.pi
    return np.asarray(np.abs(steps) <= FOLLOWS)


def _node_values(first: int, rows: Bytes) -> Nodes:
    ranges = rows[:, 3].astype(np.int64) | rows[:, 4].astype(np.int64) << 8
    return Nodes(
        first,
        np.asarray(rows[:, 0] & 1 == 1),
        _angles(rows),
        ranges / 4000.0,
        (rows[:, 0] >> 2).astype(np.float64),
    )


def _capsule_is_sound(row: Bytes) -> bool:
    """Tell whether 84 bytes are a capsule: sync nibbles A and 5, and their XOR."""
    told = (row[0] & 0xF) | (row[1] & 0xF) << 4
    return bool(
        row[0] >> 4 == 0xA and row[1] >> 4 == 0x5 and np.bitwise_xor.reduce(row[2:]) == told
    )


def _capsule_begin(row: Bytes) -> tuple[bool, float]:
    """Return whether a capsule is the first of its stream, and the angle at which it begins."""
    raw = int(row[2]) | int(row[3]) << 8
    return raw >= 0x8000, math.radians((raw & 0x7FFF) / 64.0) % (2 * math.pi)


def _capsule_values(first: int, row: Bytes, begin: float, span: float) -> Nodes:
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
