"""The .dat logs of tinySLAM (CoreSLAM) and BreezySLAM: a Hokuyo URG-04LX and wheel encoders.

One line per scan: a 32-bit count of microseconds, the two encoders in ticks, and 682 ranges in mm from the
robot's right to its left, among undocumented numbers. There are two layouts, with different numbers of
words. See Steux and El Hamzaoui 2010, "CoreSLAM: a SLAM algorithm in less than 200 lines of C code".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from impslam.columns import Columns
from impslam.component import register
from impslam.errors import MessageError
from impslam.sources.base import Stream
from impslam.sources.parts import LocatedMessage, Piece, single
from impslam.sources.tables import Lines
from impslam.sources.text import TextSource, beam_angles, beam_times, check_finite, head, numbers
from impslam.sources.urg04lx import BEAM_TIME, RANGE_MIN, STEP
from impslam.types import Array, LaserScan, WheelAngles

BEAMS = 682  # steps 44 to 725
START = (44 - 384) * STEP  # rad; step 384 points forward
RANGE_MAX = 5.6  # m
_TURN = 1 << 32  # us; the clock wraps


@dataclass(frozen=True, slots=True)
class Layout:
    """Indices of the encoders and the first range in a line, and the sign of the right encoder."""

    left: int
    right: int
    right_sign: float
    ranges: int


LAYOUTS = {707: Layout(2, 3, 1.0, 24), 695: Layout(1, 2, -1.0, 12)}


@register("dat")
class TinySlam(TextSource):
    """tinySLAM or BreezySLAM .dat log: URG-04LX scans and wheel encoder ticks."""

    default_preset: ClassVar[str] = "mines-rover"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by the number of words, all of which are numbers."""
        return any(_is_record(line) for line in head(path)[:3])

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of a block of lines: as a table, or one by one if any is not valid."""
        del rows  # a block is small
        clock = MicrosecondClock()
        for first, block in self._blocks(self.path):
            lines = Lines(block)
            yield _table(lines, first, clock) or list(self._one_by_one(lines, first, clock))

    def _one_by_one(self, lines: Lines, first: int, clock: MicrosecondClock) -> Iterator[Piece]:
        for k in range(len(lines)):
            number = first + k
            try:
                wheels, scan = _record(lines.line(k).split(), clock)
            except (ValueError, MessageError) as error:
                self._reject("line", self.path, number, error)
                continue
            yield single(LocatedMessage(wheels, number, "encoders", checked=False), 2 * number)
            yield single(LocatedMessage(scan, number, "lidar"), 2 * number + 1)

    def streams(self) -> list[Stream]:
        """Return encoders and scans, one of each per line."""
        count = sum(self._first_words(self.path).values())
        return [
            Stream("encoders", "WheelAngles", count, True, "ticks", default=True),
            Stream("lidar", "LaserScan", count, True, "URG-04LX", default=True),
        ]


class MicrosecondClock:
    """Unwraps a 32-bit count of microseconds: each time is the one nearest to the previous time."""

    def __init__(self) -> None:
        self._time: int | None = None

    def seconds(self, count: int) -> float:
        """Return the time of a count in s."""
        if not 0 <= count < _TURN:
            raise MessageError(f"stamp {count} is not a 32-bit count")
        last = count if self._time is None else self._time
        self._time = last + (count - last + _TURN // 2) % _TURN - _TURN // 2
        return self._time * 1e-6


def _table(lines: Lines, first: int, clock: MicrosecondClock) -> list[Piece]:
    """Return the rows of lines that are all valid and of one layout; nothing otherwise."""
    words = lines.line(0).split()
    layout = LAYOUTS.get(len(words))
    if layout is None:
        return []
    values, good = lines.table(np.arange(len(lines)), 0, len(words), 0)
    left, right = values[:, layout.left], values[:, layout.right] * layout.right_sign
    counts = [lines.word(k) for k in range(len(lines))]
    plain = all(count.isdigit() and int(count) < _TURN for count in counts)
    if not (plain and good.all() and np.isfinite(left + right).all()):
        return []
    stamps = np.array([clock.seconds(int(count)) for count in counts])
    ranges = values[:, layout.ranges :][:, :BEAMS] / 1000.0
    scan = _scan(stamps[0], ranges[0])
    places = first + np.arange(len(lines))
    wheels = {"stamp": stamps, "left": left.copy(), "right": right}
    sweeps = {"stamp": stamps, "ranges": ranges}
    shared = single(LocatedMessage(scan, 0, "lidar"), 0).columns.layout
    return [
        Piece.of(Columns("encoders", WheelAngles, 2 * places, wheels, {}), places, checked=False),
        Piece.of(Columns("lidar", LaserScan, 2 * places + 1, sweeps, shared), places),
    ]


def _record(tokens: list[bytes], clock: MicrosecondClock) -> tuple[WheelAngles, LaserScan]:
    layout = LAYOUTS.get(len(tokens))
    if layout is None:
        raise MessageError(f"{len(tokens)} words instead of {' or '.join(map(str, LAYOUTS))}")
    left, right = float(tokens[layout.left]), float(tokens[layout.right]) * layout.right_sign
    check_finite("encoder", left, right)
    ranges = numbers(tokens[layout.ranges : layout.ranges + BEAMS]) / 1000.0
    stamp = clock.seconds(int(tokens[0]))
    return WheelAngles(stamp, left, right), _scan(stamp, ranges)


def _scan(stamp: float, ranges: Array) -> LaserScan:
    angles, times = beam_angles(BEAMS, START, STEP), beam_times(BEAMS, BEAM_TIME)
    return LaserScan(stamp, angles, ranges, times, RANGE_MIN, RANGE_MAX)


def _is_record(line: bytes) -> bool:
    tokens = line.split()
    if len(tokens) not in LAYOUTS:
        return False
    try:
        numbers(tokens)
    except ValueError:
        return False
    return True
