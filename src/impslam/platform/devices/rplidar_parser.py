"""Parse an RPLidar's bytes to answers and measurements, even if bytes were lost or corrupted.

A node is accepted only if its angle is consistent with the one before and `HELD_BACK` valid ones follow
it, and after a loss only if `MIN_CHAIN` consecutive ones are consistent (a probability of 6e-7 in random
bytes). A capsule is accepted only with the next one, which gives the angle of its end.
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
    are_consecutive,
    capsule_begin,
    capsule_values,
    is_valid_capsule,
    is_valid_node,
    node_values,
)

MIN_CHAIN = 4  # consecutive consistent nodes before a stream is accepted
HELD_BACK = 2  # nodes that are held back until as many valid ones follow
MAX_SPAN_CHANGE = 0.25  # relative, from capsule to capsule; more means a lost capsule
MAX_SPAN = math.radians(120.0)  # of a capsule: 15 Hz at 2 kHz is 86 deg


class Parser:
    """Parses pieces of a byte stream to answers and nodes; never raises.

    `counts` has "corrupt" (invalid nodes, or nodes of invalid capsules) and "gaps" (valid ones that
    were inconsistent with those before).
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Discard all bytes and expect an answer."""
        self._buffer = bytearray()
        self._stream: Command | None = None
        self._position = 0  # bytes of the stream that have left the buffer
        self._last: float | None = None  # angle of the node before, None: must be aligned
        self._capsule: Bytes | None = None  # waits for the next one, which gives its end
        self._span = 0.0  # rad, width of the capsule before

    @property
    def received(self) -> int:
        """Number of the measurement after the last complete one."""
        return self._number(self._position + len(self._buffer))

    def feed(self, data: bytes) -> list[Answer | Nodes]:
        """Add bytes and return the answers and nodes that they complete."""
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
                del self._buffer[:-1]  # the last byte may be half of a sync
        return found

    # ------------------------------------------------------------------ nodes

    def _nodes(self) -> list[Nodes]:
        found: list[Nodes] = []
        while self._last is not None or self._align():
            rows = np.frombuffer(bytes(self._buffer), np.uint8)
            rows = rows[: len(rows) // NODE * NODE].reshape(-1, NODE)
            angles = angles_of(rows)
            before = angles if self._last is None else np.append(self._last, angles)
            good = is_valid_node(rows)
            good[len(rows) - len(before) + 1 :] &= are_consecutive(before)
            number = len(rows) if good.all() else int(good.argmin())
            accepted = max(number - HELD_BACK, 0)
            if accepted:
                found.append(node_values(self._number(self._position), rows[:accepted]))
                self._last = float(angles[accepted - 1])
                self._drop(NODE * accepted)
            if number == len(rows):
                break
            self._last = None
            self._count_lost(NODE * (number - accepted))  # the last one may be part of another
            self._drop(NODE * (number - accepted))
        return found

    def _align(self) -> bool:
        """Skip to `MIN_CHAIN` consecutive nodes; return False if there are none yet."""
        data = np.frombuffer(bytes(self._buffer), np.uint8)
        places = len(data) - NODE * MIN_CHAIN + 1
        if places <= 0:
            return False
        windows = np.lib.stride_tricks.sliding_window_view(data, NODE)
        good, angles = is_valid_node(windows), angles_of(windows)
        chained = np.ones(places, np.bool_)
        for k in range(MIN_CHAIN):
            chained &= good[NODE * k :][:places]
        for k in range(MIN_CHAIN - 1):
            a, b = angles[NODE * k :][:places], angles[NODE * (k + 1) :][:places]
            chained &= are_consecutive(np.stack([a, b]))[0]
        place = int(chained.argmax()) if chained.any() else places
        if place:
            self._count_lost(place)
        elif self._position:
            self.counts["gaps"] += 1
        self._drop(place)
        return bool(place < places)

    def _count_lost(self, number: int) -> None:
        """Count skipped bytes as measurements; a part of a node or capsule counts once."""
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
            if not is_valid_capsule(row):
                self._seek_capsule()
                continue
            nodes = self._finish_capsule(row)
            if nodes is not None:
                found.append(nodes)
            self._capsule = row
            self._drop(CAPSULE)
        return found

    def _seek_capsule(self) -> None:
        """Skip to the next place where a capsule may begin."""
        if self._capsule is not None:
            self.counts["corrupt"] += SAMPLES  # its end stays unknown
        self._capsule, self._span = None, 0.0
        data = np.frombuffer(bytes(self._buffer), np.uint8)
        marks = np.flatnonzero((data[1:-1] >> 4 == 0xA) & (data[2:] >> 4 == 0x5)) + 1
        skipped = int(marks[0]) if len(marks) else len(data) - 1
        self._count_lost(skipped)
        self._drop(skipped)

    def _finish_capsule(self, row: Bytes) -> Nodes | None:
        """Return the measurements of the waiting capsule, which ends where the next one begins."""
        fresh, angle = capsule_begin(row)
        if self._capsule is None or fresh:
            return None
        _, begin = capsule_begin(self._capsule)
        span, before = (angle - begin) % (2 * math.pi), self._span
        self._span = span
        if span > MAX_SPAN or (before and abs(span - before) > MAX_SPAN_CHANGE * before):
            self.counts["gaps"] += 1
            return None
        return capsule_values(self._number(self._position - CAPSULE), self._capsule, begin, span)
