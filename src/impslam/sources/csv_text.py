"""The text of a CSV file: what separates its cells, where its rows begin, and cells as numbers.

Spreadsheets of many countries write semicolons between cells and decimal commas; numpy.savetxt writes
spaces. Quotes around a cell may enclose what separates cells (RFC 4180). A cell may be a list, as all
ranges of a scan in what Python programs write of ROS messages; it is read as a cell for each number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.errors import MessageError
from impslam.sources.csv_times import time_of
from impslam.sources.text import head
from impslam.types import Array

SPACE = b" "  # or several, or tabs
SEPARATORS = (b",", b";", b"\t", b"|", SPACE)
BOM = b"\xef\xbb\xbf"
MAX_OPENING = 50  # lines in which the header and two rows are looked for, more than any preamble
MIN_COLUMNS = 4  # a stamp and three ranges
MISSING = ("", "na", "n/a", "#n/a", "#nv", "<na>", "null", "none")
"""Values that spreadsheets, databases and data frames write where there is none, in lower case."""
_COMMENT = b"#% "
_ENCLOSED = b"\0"  # stands for what separates cells, but within quotes; no text has it


class Opening(NamedTuple):
    """The first lines of a file.

    Attributes
    ----------
    first, second : the cells of the header, or of the first row, and those of the row after it
    has_header : whether the first ones are a header
    begin : the number of the line of the first row
    mark : what separates cells
    """

    first: list[bytes]
    second: list[bytes]
    has_header: bool
    begin: int
    mark: bytes

    @property
    def is_csv(self) -> bool:
        """Whether it can be CSV: numbers with spaces, without a header, are of many other formats."""
        return self.has_header or self.mark != SPACE

    @property
    def widths(self) -> tuple[int, int] | None:
        """The numbers of cells of both, or None if the second has too few numbers."""
        is_table = self.numbers >= MIN_COLUMNS and not self.is_json
        return (len(self.first), len(self.second)) if is_table else None

    @property
    def numbers(self) -> int:
        """The number of cells of the second that are numbers, times, or missing."""
        return sum(map(_is_cell, self.second))

    @property
    def is_json(self) -> bool:
        """Whether it can be JSON, which has commas, too."""
        return any(b"{" in cell for cell in self.first)


def opening(path: Path) -> Opening:
    """Return the first lines of a file; a missing one has no cells."""
    lines = [trim(line) for line in head(path)[:MAX_OPENING]]
    found = [k for k, line in enumerate(lines) if line.strip() and line[:1] != b"#"]
    if not found:
        return Opening([], [], False, 1, b",")
    mark = _separator([lines[k] for k in found[:2]])
    if mark == SPACE:
        lines = [line.lstrip(_COMMENT) for line in lines]
    rows = [split(line, mark) for line in lines]
    if _is_row(rows[found[0]]):  # the header may be one of the comments
        width = len(rows[found[0]])
        found = [*[k for k in range(found[0]) if len(rows[k]) == width][:1], *found]
    second = rows[found[1]] if len(found) > 1 else []
    first, has_header = rows[found[0]], not _is_row(rows[found[0]])
    if has_header:
        first = _names([_cells(lines[k], mark) for k in found[:2]])
    return Opening(first, second, has_header, found[0] + 1 + has_header, mark)


def explain(found: Opening) -> str:
    """Say why the first lines of a file are not those of a CSV log, and what to do; "" if it has none."""
    width, second = len(found.first), len(found.second)
    if not found.first or found.is_json:
        return ""
    if not found.second:
        return "it has a single line; write the names of the columns in it, and the rows below"
    if width != second:
        is_split = found.mark == b"," and 1 < width < second / 1.5  # as by decimal commas
        points = ", with decimal points" if is_split else ""
        return (
            f"its first line has {_cell_count(width)} and its second {second}; write every line with as "
            f"many, separated alike{points}, and leave those without a value empty"
        )
    if width < MIN_COLUMNS:
        return (
            f"its lines have {_cell_count(width)} instead of {MIN_COLUMNS} or more; write a stamp and the "
            "ranges of at least three beams in each, separated by commas or semicolons"
        )
    if found.numbers < MIN_COLUMNS:
        return (
            f"its second line has fewer than {MIN_COLUMNS} numbers; write the names of the columns in the "
            "first line, and numbers in all others"
        )
    return "name the columns in its first line if spaces separate the numbers"


def _cell_count(n: int) -> str:
    return f"{n} cell" if n == 1 else f"{n} cells"


def trim(line: bytes) -> bytes:
    """Return a line without its end and outer spaces, but with tabs, which may separate cells."""
    return line.removeprefix(BOM).strip(b" \r\n")


def split(text: bytes, mark: bytes) -> list[bytes]:
    """Return the cells of a row without quotes, and those of lists.

    A comma that separates nothing is a decimal point.
    """
    if b"[" in text or b"(" in text:
        return [cell for whole in _cells(text, mark) for cell in _unlisted(whole, mark)]
    return _cells(text if mark == b"," else text.replace(b",", b"."), mark)


def _unlisted(cell: bytes, mark: bytes) -> list[bytes]:
    """Return the numbers of a list, or a cell that is none."""
    text = cell.strip()
    if (text[:1], text[-1:]) in ((b"[", b"]"), (b"(", b")")):
        return text[1:-1].split(b",")
    return [cell if mark == b"," else cell.replace(b",", b".")]


def _cells(text: bytes, mark: bytes) -> list[bytes]:
    """Return the cells of a line without quotes."""
    at = None if mark == SPACE else mark
    if b'"' not in text:
        return text.split(at)
    parts = text.split(b'"')
    if mark not in b"".join(parts[1::2]):
        return b"".join(parts).split(at)
    parts[1::2] = [part.replace(mark, _ENCLOSED) for part in parts[1::2]]
    return [cell.replace(_ENCLOSED, mark) for cell in b"".join(parts).split(at)]


def _names(lines: Sequence[list[bytes]]) -> list[bytes]:
    """Return the cells of a header, with one for each number of a list in the row after it."""
    header, row = lines[0], lines[-1]
    if len(row) != len(header):
        return header
    counts = [len(_unlisted(cell, b",")) for cell in row]
    return [
        name + b"%d" % k if count > 1 else name
        for name, count in zip(header, counts, strict=True)
        for k in range(count)
    ]


def _separator(lines: Sequence[bytes]) -> bytes:
    """Return the mark that gives the most numbers in the last of some lines, or cells in the first."""

    def score(mark: bytes) -> tuple[int, int]:
        return sum(map(_is_cell, split(lines[-1], mark))), lines[0].count(mark)

    return max(SEPARATORS, key=score)


def names(cells: Sequence[bytes]) -> list[str]:
    """Return the cells of a header, without the sign of a comment."""
    found = [_decode(cell).strip(" \t") for cell in cells]
    return [found[0].lstrip(_COMMENT.decode()), *found[1:]] if found else []


def _decode(cell: bytes) -> str:
    """Return text in UTF-8, or else in the code page of Western Windows, whose degree sign is one byte."""
    try:
        return cell.decode("utf-8")
    except UnicodeDecodeError:
        return cell.decode("cp1252", "replace")


def _is_row(cells: Sequence[bytes]) -> bool:
    """Return whether cells are a row rather than a header, which may name beams by numbers.

    The name of a column of row numbers may be empty.
    """
    first = cells[0].strip(b"#% \t") if cells else b""
    return bool(first) and _is_cell(first) and sum(map(_is_cell, cells)) >= len(cells) / 2


def numbers(cells: Sequence[bytes], used: Sequence[int], width: int) -> Array:
    """Return the numbers (width,) in the used columns; NaN in other columns and empty cells.

    Raises
    ------
    MessageError
        If there are not `width` cells, or one that is used is neither a number, nor a time, nor missing.
    """
    if len(cells) != width:
        raise MessageError(f"{len(cells)} cells instead of {width}; write every line with as many")
    values = np.full(width, np.nan)
    try:
        values[used] = [float(cells[k]) if cells[k].strip() else math.nan for k in used]
    except ValueError:
        values[used] = [_number(cells[k]) for k in used]
    return values


def _number(cell: bytes) -> float:
    """Return a cell as a number, or s by `time_of`; NaN for the words for a missing value."""
    text = cell.decode("utf-8", "replace").strip()
    try:
        return math.nan if text.lower() in MISSING else float(text)
    except ValueError:
        pass
    try:
        return time_of(text)
    except ValueError:
        raise MessageError(
            f"{text[:40]!r} is not a number, or a time such as 2024-12-31T09:00:00.25"
        ) from None


def _is_cell(text: bytes) -> bool:
    """Return whether a cell is a number, a date with a time, a time of day, or missing."""
    try:
        _number(text)
    except MessageError:
        return False
    return True
