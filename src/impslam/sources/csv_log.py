"""CSV files whose rows contain odometry, a scan, or both; the columns are recognised by name.

The odometry cells or all ranges of a row may be empty; a single empty range is a beam without return.
Lines that start with # are comments, except a header with as many cells as the first row.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Self

from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources.base import Stream
from impslam.sources.csv_cells import CsvCells
from impslam.sources.csv_columns import (
    ECHO,
    MOTIONS,
    CsvLayout,
    Role,
    layout,
    shorten,
)
from impslam.sources.csv_rows import odometry, odometry_kind, scan, stamp_of, unit_of
from impslam.sources.csv_text import (
    MIN_COLUMNS,
    explain,
    names,
    numbers,
    opening,
    split,
    trim,
)
from impslam.sources.csv_times import after_midnight, is_clock
from impslam.sources.parts import LocatedMessage
from impslam.sources.text import TextSource
from impslam.types import (
    LaserScan,
    Message,
    OdometryPose,
    Velocity,
    WheelAngles,
)

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

    _mark: bytes = PrivateAttr(default=b",")
    _begin: int = PrivateAttr(default=0)  # number of the first line that may be a row
    _header: list[str] = PrivateAttr(default_factory=list)
    _named: bool = PrivateAttr(default=False)  # whether the file has a header
    _layout: CsvLayout | None = PrivateAttr(default=None)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by two lines with equal numbers of cells, and numbers in the second."""
        found = opening(path)
        widths = found.widths
        return found.is_csv and widths is not None and widths[0] == widths[1]

    @classmethod
    def explain_refusal(cls, path: Path) -> str:
        """Say what keeps a file of numbers in cells, or one named `.csv`, from being a CSV log."""
        if path.is_file() and _starts_with_utf16(path):
            return "it is text in UTF-16; save it as UTF-8"
        found = opening(path)
        is_meant = found.widths is not None and min(found.widths) >= MIN_COLUMNS
        if not is_meant and ".csv" not in path.suffixes:
            return ""
        why = explain(found)
        return f"for a CSV log, {why}" if why else ""

    def __enter__(self) -> Self:
        super().__enter__()
        found = opening(self.path)
        self._mark, self._begin = found.mark, found.begin
        count = range(1, len(found.first) + 1)
        self._named = found.has_header
        self._header = names(found.first) if self._named else list(map(str, count))
        return self

    def kinds(self) -> frozenset[type[Message]]:
        """Return scans, and the kind of odometry in the columns."""
        motion = odometry_kind(self._columns())
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

    def missing_scans(self) -> str:
        """Say that all ranges are missing if no row is malformed."""
        if not self._columns().has_ranges or "malformed row" in self.problems.counts:
            return ""
        return "the ranges of all rows are empty or NaN: check the lidar and what wrote the file"

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
                angles = self.angle_min, self.angle_step
                self._layout = layout(self._header, self.columns, *angles, named=self._named)
            except MessageError as error:
                raise SourceError(f"{self.path}: {error}") from None
        return self._layout

    def _messages(self) -> Iterator[LocatedMessage]:
        """Yield the odometry of a row before its scan."""
        found, width, unit, last = self._columns(), len(self._header), 0.0, 0.0
        used = sorted({k for cells in found.cells.values() for k in range(*cells[:2])})
        for number, line in self._lines(self.path):
            text = trim(line)
            if number < self._begin or not text.strip() or text[:1] == b"#":
                continue
            try:
                cells = split(text, self._mark)
                values = numbers(cells, used, width)
                stamp = stamp_of(values, found)
                unit = unit or unit_of(stamp)
                stamp *= unit
                if is_clock(cells[found.cells["stamp"].first]):
                    stamp = last = after_midnight(stamp, last)
                row = [*odometry(values, found, stamp), *scan(values, found, stamp)]
            except (ValueError, MessageError) as error:
                self._reject("row", self.path, number, error)
                continue
            for k, message in enumerate(row):
                stream = STREAMS[type(message)]
                yield LocatedMessage(message, number, stream, checked=k == len(row) - 1)


def _starts_with_utf16(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) in (b"\xff\xfe", b"\xfe\xff")
