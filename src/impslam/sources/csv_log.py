"""CSV files whose rows contain odometry, a scan, or both; the columns are recognised by name.

The odometry cells or all ranges of a row may be empty; a single empty range is a beam without return.
Lines that start with # are comments, except a header with as many cells as the first row.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources.base import Stream
from impslam.sources.csv_columns import ECHO, MOTIONS, CsvCells, CsvLayout, Role, layout, shorten
from impslam.sources.parts import LocatedMessage
from impslam.sources.text import TextSource, beam_angles, beam_times, check_finite, head
from impslam.sources.transforms import yaw_of
from impslam.types import (
    Array,
    LaserScan,
    Message,
    OdometryPose,
    Velocity,
    WheelAngles,
    range_limits,
)

SEPARATORS = (b",", b";", b"\t")
BOM = b"\xef\xbb\xbf"
MAX_OPENING = 50  # lines in which the header and two rows are looked for, more than any preamble
MIN_COLUMNS = 4  # a stamp and three ranges
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Stamps above which the unit is ns, us or ms since 1970; in s, 1e11 would be the year 5138."""


STREAMS: dict[type[Message], str] = {
    LaserScan: "ranges",
    OdometryPose: "pose",
    WheelAngles: "wheels",
    Velocity: "velocity",
}


@register("csv")
class CsvLog(TextSource):
    """CSV with columns named in a header or by `columns`."""

    describes_robot: ClassVar[bool] = True

    columns: dict[Role, str] = parameter(
        {}, "1", "column of each role: NAME, or FIRST:LAST for ranges, either with *FACTOR"
    )
    angle_min: float = parameter(math.nan, "rad", "direction of the first beam; nan: from the file")
    angle_step: float = parameter(
        math.nan, "rad", "angle from beam to beam, counter-clockwise; nan: from the file"
    )

    _has_header: bool = PrivateAttr(default=True)
    _mark: bytes = PrivateAttr(default=b",")
    _begin: int = PrivateAttr(default=0)  # number of the first line that may be a row
    _header: list[str] = PrivateAttr(default_factory=list)
    _layout: CsvLayout | None = PrivateAttr(default=None)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by two lines with equal numbers of cells, and numbers in the second."""
        widths = _first_widths(path)
        return widths is not None and widths[0] == widths[1]

    @classmethod
    def explain_refusal(cls, path: Path) -> str:
        """Say that a file is UTF-16, has decimal commas, or lines of different length."""
        if path.is_file() and _starts_with_utf16(path):
            return "it is text in UTF-16; save it as UTF-8"
        if sum(map(_has_decimal_comma, _opening(path).second)) >= MIN_COLUMNS:
            return "for a CSV log, its numbers have decimal commas; write points, as in 1.5"
        widths = _first_widths(path)
        if widths is None or min(widths) < MIN_COLUMNS:
            return ""
        return (
            f"for a CSV log, its first line has {widths[0]} cells and its second {widths[1]}; "
            "write every line with as many, and leave those without a value empty"
        )

    def __enter__(self) -> Self:
        super().__enter__()
        opening = _opening(self.path)
        cells = _names(opening.first)
        self._mark, self._has_header = opening.mark, not _is_row(cells)
        self._begin = opening.number + self._has_header
        self._header = cells if self._has_header else [str(k + 1) for k in range(len(cells))]
        return self

    def kinds(self) -> frozenset[type[Message]]:
        """Return scans, and the kind of odometry in the columns."""
        motion = self._motion()
        scans = {LaserScan} if self._columns().has_ranges else set()
        return frozenset(scans if motion is None else {*scans, motion})

    def unknown_odometry(self) -> str:
        """Name the columns without a role if none are odometry."""
        found, is_echo = self._columns(), any(name.startswith(ECHO) for name in self._header)
        if found.motion or is_echo or not found.unread:
            return ""
        return (
            f"columns {shorten(found.unread)} are not read, and none is odometry: that is named "
            f"{' or '.join(map('+'.join, MOTIONS))}, or by --columns x=NAME,y=NAME,theta=NAME"
        )

    def defaults(self) -> Mapping[type[Message], str]:
        """Return the streams of the file."""
        return {kind: STREAMS[kind] for kind in self.kinds()}

    def streams(self) -> list[Stream]:
        """Return odometry and scans, with their columns."""
        streams, found = [], self._columns()
        for kind, name in sorted(self.defaults().items(), key=lambda item: item[1]):
            roles = ("ranges",) if kind is LaserScan else found.motion
            cells = [found.cells[role] for role in roles]
            streams.append(
                Stream(name, kind.__name__, None, True, self._describe(cells), default=True)
            )
        return streams

    def _describe(self, cells: list[CsvCells]) -> str:
        firsts = [self._header[one.first] for one in cells]
        if cells[0].last - cells[0].first > 1:
            return f"columns {firsts[0]} to {self._header[cells[0].last - 1]}"
        return f"columns {', '.join(firsts)}"

    def _columns(self) -> CsvLayout:
        if self._layout is None:
            try:
                self._layout = layout(self._header, self.columns, self.angle_min, self.angle_step)
            except MessageError as error:
                raise SourceError(f"{self.path}: {error}") from None
        return self._layout

    def _motion(self) -> type[Message] | None:
        kinds: dict[str, type[Message]] = {
            "x": OdometryPose,
            "left": WheelAngles,
            "speed": Velocity,
        }
        motion = self._columns().motion
        return kinds[motion[0]] if motion else None

    def _messages(self) -> Iterator[LocatedMessage]:
        """Yield the odometry of a row before its scan."""
        found, width, unit = self._columns(), len(self._header), 0.0
        used = sorted({k for cells in found.cells.values() for k in range(*cells[:2])})
        for number, line in self._lines(self.path):
            text = _trim(line)
            if number < self._begin or not text.strip() or text[:1] == b"#":
                continue
            try:
                values = _numbers(text.split(self._mark), used, width)
                stamp = _value(values, found.cells["stamp"])
                check_finite("the stamp", stamp)
                unit = unit or next((factor for low, factor in EPOCHS if abs(stamp) > low), 1.0)
                motion = self._odometry(values, found, stamp * unit)
                row = [*motion, *_scan(values, found, stamp * unit)]
            except (ValueError, MessageError) as error:
                self._reject("row", self.path, number, error)
                continue
            for k, message in enumerate(row):
                stream = STREAMS[type(message)]
                yield LocatedMessage(message, number, stream, checked=k == len(row) - 1)

    def _odometry(self, values: Array, found: CsvLayout, stamp: float) -> Iterator[Message]:
        """Yield the odometry of a row, unless its cells are empty."""
        cells = [_value(values, found.cells[role]) for role in found.motion]
        if not cells or all(map(math.isnan, cells)):
            return
        check_finite("odometry", *cells)
        kind = self._motion()
        if kind is OdometryPose:
            x, y, *turn = cells
            yaw = turn[0] if len(turn) == 1 else yaw_of(*turn)
            yield OdometryPose(stamp, np.array([x, y, yaw]))
        elif kind is WheelAngles:
            yield WheelAngles(stamp, *cells)
        else:
            yield Velocity(stamp, *cells)


class _Opening(NamedTuple):
    """The cells of the header, or of the first row; those of the row after it; and where they are.

    `number` is the number of the line of the header, or of the first row; `mark` separates cells.
    """

    first: list[bytes]
    second: list[bytes]
    number: int
    mark: bytes


def _opening(path: Path) -> _Opening:
    """Return the first lines of a file; a missing one has no cells."""
    lines = [_trim(line) for line in head(path)[:MAX_OPENING]]
    found = [k for k, line in enumerate(lines) if line.strip() and line[:1] != b"#"]
    if not found:
        return _Opening([], [], 1, b",")
    mark = _separator(lines[found[0]])
    cells = [line.split(mark) for line in lines]
    if _is_row(_names(cells[found[0]])):  # the header may be one of the comments
        width = len(cells[found[0]])
        found = [*[k for k in range(found[0]) if len(cells[k]) == width][:1], *found]
    second = cells[found[1]] if len(found) > 1 else []
    return _Opening(cells[found[0]], second, found[0] + 1, mark)


def _names(cells: list[bytes]) -> list[str]:
    """Return the cells of a header without quotes, and without the sign of a comment."""
    names = [cell.decode("utf-8", "replace").strip(' \t"') for cell in cells]
    return [names[0].lstrip("#% "), *names[1:]] if names else []


def _is_row(names: list[str]) -> bool:
    """Return whether cells are a row rather than a header, which may name beams by numbers."""
    numbers = [_is_cell(name.encode()) for name in names]
    return numbers[:1] == [True] and sum(numbers) >= len(names) / 2


def _first_widths(path: Path) -> tuple[int, int] | None:
    """Return the numbers of cells of the first two lines, or None if the second has too few numbers."""
    first, second, *_ = _opening(path)
    if any(b"{" in cell for cell in first):  # JSON has commas, too
        return None
    return (len(first), len(second)) if sum(map(_is_cell, second)) >= MIN_COLUMNS else None


def _starts_with_utf16(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) in (b"\xff\xfe", b"\xfe\xff")


def _has_decimal_comma(cell: bytes) -> bool:
    return cell.count(b",") == 1 and _is_cell(cell.replace(b",", b"."))


def _scan(values: Array, found: CsvLayout, stamp: float) -> Iterator[LaserScan]:
    """Yield the scan of a row, unless its cells are empty."""
    if not found.has_ranges:
        return
    beams = found.cells["ranges"]
    ranges = beams.factor * values[beams.first : beams.last]
    if np.isnan(ranges).all():
        return
    angles = found.angles
    if angles is None:
        start, step = (_value(values, found.cells[role]) for role in ("angle_min", "angle_step"))
        check_finite("angle_min or angle_step", start, step)
        angles = beam_angles(len(ranges), start, step)
    low, high = (
        _value(values, found.cells[role]) if role in found.cells else math.nan
        for role in ("range_min", "range_max")
    )
    yield LaserScan(stamp, angles, ranges, beam_times(len(ranges)), *range_limits(low, high))


def _numbers(cells: list[bytes], used: list[int], width: int) -> Array:
    """Return the numbers (width,) in the used columns; NaN in other columns and empty cells."""
    if len(cells) != width:
        raise MessageError(f"{len(cells)} cells instead of {width}")
    values = np.full(width, np.nan)
    values[used] = [float(cells[k]) if cells[k].strip() else math.nan for k in used]
    return values


def _value(values: Array, cells: CsvCells) -> float:
    return cells.factor * float(values[cells.first])


def _trim(line: bytes) -> bytes:
    """Return a line without its end and outer spaces, but with tabs, which may separate cells."""
    return line.removeprefix(BOM).strip(b" \r\n")


def _separator(line: bytes) -> bytes:
    return max(SEPARATORS, key=line.count)


def _is_cell(text: bytes) -> bool:
    """Return whether a cell is a number or empty."""
    try:
        float(text.strip() or b"nan")
    except ValueError:
        return False
    return True
