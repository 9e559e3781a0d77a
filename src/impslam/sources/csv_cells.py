"""Columns of a CSV file: their units, and which of them are the beams of a scan."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.sources.text import beam_angles
from impslam.types import Array

UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3,
    "rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0,
    "m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3,
    "rad/s": 1.0, "deg/s": math.pi / 180.0, "°/s": math.pi / 180.0,
}  # fmt: skip
MIN_BEAMS = 3  # minimum number of consecutively numbered columns to recognise them as beams
EXTRAS = ("covariance", "intensit", "header", "angle_max", "scan_time")
"""Parts of the names of other columns, often numbered ones, in what programs write of ROS messages."""


class CsvCells(NamedTuple):
    """Columns first to last - 1, and the factor that converts their numbers to m, s or rad."""

    first: int
    last: int
    factor: float


def find_beams(header: Sequence[str]) -> CsvCells | None:
    """Return the longest run of columns whose names are numbers, or one name with a number after it."""
    stems = [_stem(name) for name in header]
    best, k = (0, 0), 0
    while k < len(stems):
        end = k
        while end < len(stems) and stems[end] is not None and stems[end] == stems[k]:
            end += 1
        best, k = max(best, (end - k, -k)), max(end, k + 1)
    count, first = best[0], -best[1]
    if count < MIN_BEAMS:
        return None
    unit = (stems[first] or "").strip("_[").rpartition("_")[2]
    return CsvCells(first, first + count, UNITS.get(unit, 1.0))


def _stem(name: str) -> str | None:
    """Return the name of a numbered column without its number, and with its unit at the end."""
    if _number(name) is not None:
        return ""
    found = re.fullmatch(r"(.*[^\d])\d+\]?(?:(?:_|\s*[\[(])(m|cm|mm)[\])]?)?", name)
    if found is None or is_extra(found[1]):
        return None
    stem, unit = found.groups()
    return f"{stem.strip('_[')}_{unit}" if unit else stem


def is_extra(name: str) -> bool:
    """Return whether a column is one of `EXTRAS`."""
    return any(other in name.lower() for other in EXTRAS)


def _number(name: str) -> float | None:
    try:
        value = float(name.replace(",", "."))  # a decimal comma, as what separates cells is no part
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def directions(names: Sequence[str], start: float, step: float) -> Array | None:
    """Return the directions (n,) rad of beams, given or as names in degrees; None if unknown."""
    if math.isfinite(start) and math.isfinite(step):
        return beam_angles(len(names), start, step)
    degrees = [_number(name) for name in names]
    return None if None in degrees else np.radians(np.array(degrees, np.float64))
