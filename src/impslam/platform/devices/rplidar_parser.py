"""From an RPLidar's bytes to answers and measurements, also where bytes were lost or spoilt.

A node is taken only where its angle follows from the one before and `HELD` sound ones follow it,
and after a loss only where `CHAIN` of them follow from each other (a chance of 6e-7 in random
bytes). A capsule is taken only with the next one, which tells where it ends.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from impslam.platform.devices.rplidar_protocol import (
    CAPSULE,
    LENGTH,
    NODE,
    SAMPLES,
    SHAPES,
    SYNC,
    Answer,
    Bytes,
    Command,
    Nodes,
    angles_of,
    capsule_begin,
    capsule_is_sound,
    capsule_values,
    follow,
    node_values,
    sound,
)

CHAIN = 4  # nodes that must follow from each other before a stream is believed
HELD = 2  # nodes that are held back until as many sound ones came after them
SPREAD = 0.25  # relative change of a turn's speed from capsule to capsule; more is a capsule lost
WIDEST = math.radians(120.0)  # of a capsule: 15 Hz at 2 kHz is 86 deg


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
        while self._stream is None and (begin := self._buffer.find(SYNC)) >= 0:
            shape = SHAPES.get(bytes(self._buffer[begin : begin + LENGTH]))
            end = begin + LENGTH + (shape.size if shape and not shape.stream else 0)
            if len(self._buffer) < end:
                break
            if shape is None:
                end = begin + 1
            elif shape.stream:
                self._stream = shape.command
            else:
                found.append(Answer(shape.command, bytes(self._buffer[begin + LENGTH : end])))
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
            angles = angles_of(rows)
            before = angles if self._last is None else np.append(self._last, angles)
            good = sound(rows)
            good[len(rows) - len(before) + 1 :] &= follow(before)
            number = len(rows) if good.all() else int(good.argmin())
            sure = max(number - HELD, 0)
            if sure:
                found.append(node_values(self._number(self._position), rows[:sure]))
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
        good, angles = sound(windows), angles_of(windows)
        chained = np.ones(places, np.bool_)
        for k in range(CHAIN):
            chained &= good[NODE * k :][:places]
        for k in range(CHAIN - 1):
            a, b = angles[NODE * k :][:places], angles[NODE * (k + 1) :][:places]
            chained &= follow(np.stack([a, b]))[0]
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
            if not capsule_is_sound(row):
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
        fresh, angle = capsule_begin(row)
        if self._capsule is None or fresh:
            return None
        _, begin = capsule_begin(self._capsule)
        span, before = (angle - begin) % (2 * math.pi), self._span
        self._span = span
        if span > WIDEST or (before and abs(span - before) > SPREAD * before):
            self.counts["gaps"] += 1
            return None
        return capsule_values(self._number(self._position - CAPSULE), self._capsule, begin, span)
