"""Dates and times of day in the cells of CSV files, as seconds."""

from __future__ import annotations

import re
from datetime import UTC, datetime

DAY = 86400.0  # s
_CLOCK = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:\.\d*)?)")
_DATE_BY_DOTS = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[T ]+(\d{1,2})(:.*)")


def time_of(text: str) -> float:
    """Return a date with a time as s since 1970, in UTC by default, or a time of day as s since midnight.

    A date is as in ISO 8601, also with slashes, or `31.12.2024 9:00:00`, as spreadsheets write it where
    decimals have commas. In `12/31/2024`, the order of day and month would be a guess.

    Raises
    ------
    ValueError
        If it is neither.
    """
    if clock := _CLOCK.fullmatch(text):
        hours, minutes, seconds = map(float, clock.groups())
        if hours < 24.0 and minutes < 60.0 and seconds < 61.0:  # a leap second is the 60th
            return 3600.0 * hours + 60.0 * minutes + seconds
    if dots := _DATE_BY_DOTS.fullmatch(text):
        day, month, year, hour, rest = dots.groups()
        text = f"{year}-{month:0>2}-{day:0>2} {hour:0>2}{rest}"
    time = datetime.fromisoformat(text.replace("/", "-", 2).replace("/", " "))
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def is_clock(cell: bytes) -> bool:
    """Return whether a cell is a time of day."""
    return b":" in cell and _CLOCK.fullmatch(cell.decode("ascii", "replace").strip()) is not None


def after_midnight(stamp: float, last: float) -> float:
    """Return a time of day, s, plus the days since the row before, whose time is `last`, began.

    Rows are less than half a day apart.
    """
    return stamp + DAY * max(round((last - stamp) / DAY), 0)
