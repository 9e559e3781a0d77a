"""A row of a CSV file as messages: odometry, a scan, or both."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.sources.csv_cells import CsvCells
from impslam.sources.csv_columns import STAMP_PAIR, CsvLayout, Role
from impslam.sources.text import beam_angles, beam_times, check_finite
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

EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Stamps above which the unit is ns, us or ms since 1970; in s, 1e11 would be the year 5138."""
LIMITS: tuple[Role, Role] = ("range_min", "range_max")


def stamp_of(values: Array, found: CsvLayout) -> float:
    """Return the stamp of a row in the unit of the file; raise `MessageError` if it is not finite."""
    stamp = sum(_value(values, found.cells[role]) for role in STAMP_PAIR if role in found.cells)
    check_finite("the stamp", stamp)
    return stamp


def unit_of(stamp: float) -> float:
    """Return the unit in s of a stamp since 1970, or 1 for small stamps."""
    return next((factor for low, factor in EPOCHS if abs(stamp) > low), 1.0)


def odometry_kind(found: CsvLayout) -> type[Message] | None:
    """Return the kind of odometry in the columns."""
    kinds: dict[str, type[Message]] = {"x": OdometryPose, "left": WheelAngles, "speed": Velocity}
    return kinds[found.motion[0]] if found.motion else None


def odometry(values: Array, found: CsvLayout, stamp: float) -> Iterator[Message]:
    """Yield the odometry of a row, unless its cells are empty."""
    cells = [_value(values, found.cells[role]) for role in found.motion]
    if not cells or all(map(math.isnan, cells)):
        return
    check_finite("odometry", *cells)
    kind = odometry_kind(found)
    if kind is OdometryPose:
        x, y, *turn = cells
        yaw = turn[0] if len(turn) == 1 else yaw_of(*turn)
        yield OdometryPose(stamp, np.array([x, y, yaw]))
    elif kind is WheelAngles:
        yield WheelAngles(stamp, *cells)
    else:
        yield Velocity(stamp, *cells)


def scan(values: Array, found: CsvLayout, stamp: float) -> Iterator[LaserScan]:
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
    wait = _value_or(0.0, "time_step", values, found)
    check_finite("time_increment", wait)
    low, high = (_value_or(math.nan, role, values, found) for role in LIMITS)
    times = beam_times(len(ranges), wait)
    yield LaserScan(stamp, angles, ranges, times, *range_limits(low, high))


def _value_or(missing: float, role: Role, values: Array, found: CsvLayout) -> float:
    """Return the value of a role in a row, or another one without such a column."""
    return _value(values, found.cells[role]) if role in found.cells else missing


def _value(values: Array, cells: CsvCells) -> float:
    return cells.factor * float(values[cells.first])
