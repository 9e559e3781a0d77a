"""Logs of the car of the Australian Centre for Field Robotics, in MATLAB files (Guivant and Nebot).

`acfr_carpark`: Time, Sensor and Index list the events in order: GPS fixes (1), speed and steering (2), and
SICK LMS scans with intensities (3). `estbeac` in a file beside it contains the surveyed beacons.

`acfr_park` (Victoria Park): u (speed, steering) at `time`, and the output of a tree detector: zt (range,
bearing from the right, diameter) at `TLsr`. The scans are not included. A file beside it contains GPS
fixes at `timeGps`, in ms.

Both are in metres, seconds and radians; GPS positions are in a local plane, without headings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import PrivateAttr

from impslam.columns import Columns
from impslam.component import parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources.base import Stream
from impslam.sources.matlab import MatlabSource, column, read_variables, same_length
from impslam.sources.parts import LocatedMessage, Piece, merge_order, single
from impslam.sources.text import beam_angles, beam_times, check_finite
from impslam.types import (
    Array,
    Detections,
    Fix,
    Ints,
    LaserScan,
    Mask,
    Message,
    Steering,
    TrueLandmark,
    TruePose,
)

STEP = math.radians(0.5)  # between beams, from right to left
FIXES = "GPS fixes"
GPS_NOTE = "positions, for scoring; source.use_fix gives some to a sensor"
USE_FIX_HELP = "a sensor reads every N-th GPS fix, the others are for scoring; 0: none"
RIGHT = math.radians(-90.0)  # the first beam
GPS = 1
NAMES = {GPS: "GPS", 2: "wheels", 3: "laser"}  # names of the carpark's sensors, by number
RANGE_MAX = 81.0  # m; a SICK LMS reports 81.91 without an echo, and other codes from 81.83 on


@register("acfr_carpark")
class Carpark(MatlabSource):
    """ACFR car with scans: Time, Sensor, Index and the listed readings."""

    use_fix: int = parameter(0, "1", USE_FIX_HELP, ge=0)
    default_preset: ClassVar[str] = "carpark"
    needs: ClassVar[frozenset[str]] = frozenset(
        {"Time", "Sensor", "Index", "TimeGPS", "GPSLon", "GPSLat"}
        | {"Time_VS", "Velocity", "Steering", "TimeLaser", "Laser", "Intensity"}
    )
    _events: list[tuple[int, int]] = PrivateAttr(default_factory=list)
    _makers: dict[int, Callable[[int], Message]] = PrivateAttr(default_factory=dict)

    def _open(self, log: Path) -> int:
        values = read_variables(log, self.needs)
        columns = {n: column(log, values, n) for n in self.needs - {"Laser", "Intensity"}}
        _check(log, columns, "Time", "Sensor", "Index")
        _check(log, columns, "TimeGPS", "GPSLon", "GPSLat")
        _check(log, columns, "Time_VS", "Velocity", "Steering")
        ranges, echoes = _table(log, values, "Laser"), _table(log, values, "Intensity")
        if ranges.shape != echoes.shape or len(ranges) != len(columns["TimeLaser"]):
            raise SourceError(
                f"{log}: Laser, Intensity and TimeLaser have different sizes; copy it again"
            )
        gps = np.column_stack([columns[n] for n in ("TimeGPS", "GPSLon", "GPSLat")])
        wheels = np.column_stack([columns[n] for n in ("Time_VS", "Velocity", "Steering")])
        self._makers = {
            1: lambda i: _fix(gps[i], bool(_used(np.array(i), self.use_fix))),
            2: lambda i: _steering(*wheels[i]),
            3: lambda i: _scan(columns["TimeLaser"][i], ranges[i], echoes[i]),
        }
        sensors, indices = np.nan_to_num(columns["Sensor"]), np.nan_to_num(columns["Index"])
        self._events = [(int(s), int(i) - 1) for s, i in zip(sensors, indices, strict=True)]
        return len(self._events)

    def _messages(self) -> Iterator[LocatedMessage]:
        for number, (sensor, index) in enumerate(self._events, 1):
            self._done = number
            try:
                message = self._message(sensor, index)
            except (IndexError, MessageError) as error:
                self._problems.add("malformed event", f"{self.path}:{number}: {error}; dropped")
            else:
                # GPS stamps are not checked: gaps are expected under trees.
                stream = FIXES if isinstance(message, Fix) else NAMES[sensor]
                yield LocatedMessage(message, number, stream, checked=sensor != GPS)

    def _message(self, sensor: int, index: int) -> Message:
        if sensor not in self._makers or index < 0:
            raise MessageError(f"no sensor {sensor} has a reading {index + 1}")
        return self._makers[sensor](index)

    def _close(self) -> None:
        self._events, self._makers = [], {}

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the surveyed beacons of the file beside the log."""
        survey = self._beside(frozenset({"estbeac"}))
        if survey is None:
            return []
        places = _table(survey, read_variables(survey, frozenset({"estbeac"})), "estbeac")
        return [
            TrueLandmark(f"beacon {i}", "point", place[:2], {})
            for i, place in enumerate(places, 1)
            if len(place) > 1 and np.isfinite(place[:2]).all()
        ]

    def streams(self) -> list[Stream]:
        """Return GPS, wheels and laser, and the survey if there is one."""
        counts = {s: sum(sensor == s for sensor, _ in self._events) for s in self._makers}
        found = [
            Stream(
                "GPS",
                "TruePose",
                counts[1],
                used=False,
                note=GPS_NOTE,
            ),
            Stream("wheels", "Steering", counts[2], True, "speed and steering", default=True),
            Stream(
                "laser", "LaserScan", counts[3], True, "SICK LMS, with brightness", default=True
            ),
        ]
        beacons = self.true_landmarks()
        if beacons:
            note = "surveyed, only for scoring"
            found.append(Stream("estbeac", "beacons", len(beacons), used=False, note=note))
        return found


@register("acfr_park")
class Park(MatlabSource):
    """ACFR car among trees (Victoria Park): u, zt and their times."""

    use_fix: int = parameter(0, "1", USE_FIX_HELP, ge=0)

    default_preset: ClassVar[str] = "victoria-park"
    needs: ClassVar[frozenset[str]] = frozenset({"time", "u", "TLsr", "zt"})
    gps: ClassVar[frozenset[str]] = frozenset({"timeGps", "Lo_m", "La_m"})
    _wheels: Array = PrivateAttr(default_factory=lambda: np.empty((0, 3)))
    _fixes: Array = PrivateAttr(default_factory=lambda: np.empty((0, 3)))
    _trees: list[tuple[float, Any]] = PrivateAttr(default_factory=list)

    def _open(self, log: Path) -> int:
        values = read_variables(log, self.needs)
        times, u = column(log, values, "time"), _table(log, values, "u")
        if u.shape != (2, len(times)):
            raise SourceError(f"{log}: u is not two rows of the length of time; copy it again")
        cells, seen = values["zt"].ravel(), column(log, values, "TLsr")
        same_length(log, TLsr=seen, zt=cells)
        self._wheels = np.column_stack((times, u.T))
        self._trees = list(zip(seen.tolist(), cells, strict=True))
        self._fixes = np.empty((0, 3))
        if (beside := self._beside(self.gps)) is not None:
            values = read_variables(beside, self.gps)
            columns = {n: column(beside, values, n) for n in self.gps}
            _check(beside, columns, "timeGps", "Lo_m", "La_m")
            milliseconds, east, north = (columns[n] for n in ("timeGps", "Lo_m", "La_m"))
            self._fixes = np.column_stack((milliseconds / 1000.0, east, north))
        return len(self._wheels) + len(self._trees) + len(self._fixes)

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield all rows, which are in memory; the motion until a scan precedes it."""
        del rows
        self._done = self._count
        wheels = self._finite_rows("wheels", self._wheels)
        fixes = self._finite_rows("GPS", self._fixes)
        trees = list(self._tree_messages())
        seen = np.array([tree.message.stamp for tree in trees])
        orders = merge_order(self._wheels[wheels, 0], self._fixes[fixes, 0], seen)
        stamp, speed, angle = self._wheels[wheels].T.copy()
        motion = {"stamp": stamp, "speed": speed, "angle": angle}
        places = self._fixes[fixes]
        poses = np.column_stack((places[:, 1:], np.full(len(places), math.nan)))
        fix = {"stamp": places[:, 0].copy(), "pose": poses}
        used = _used(np.arange(len(fixes)), self.use_fix)
        unknown = np.full((len(fixes), 2, 2), math.nan)
        used_fix = {"stamp": fix["stamp"], "position": poses[:, :2].copy(), "covariance": unknown}
        part = [
            Piece.of(Columns("wheels", Steering, orders[0], motion, {}), wheels + 1),
            Piece.of(
                Columns("GPS", TruePose, orders[1], fix, {}).take(~used), fixes[~used] + 1, False
            ),
            Piece.of(
                Columns(FIXES, Fix, orders[1], used_fix, {}).take(used), fixes[used] + 1, False
            ),
            *(single(*tree) for tree in zip(trees, orders[2].tolist(), strict=True)),
        ]
        yield [piece for piece in part if len(piece.columns)]

    def _finite_rows(self, stream: str, rows: Array) -> Ints:
        """Return the indices of the finite rows, and report the others."""
        good = np.isfinite(rows.sum(axis=1))
        what = "stamp, speed or steering" if stream == "wheels" else "stamp or position"
        for k in np.flatnonzero(~good):
            self._reject(stream, int(k) + 1, f"{what} is not finite")
        return np.flatnonzero(good)

    def _tree_messages(self) -> Iterator[LocatedMessage]:
        for number, (stamp, cell) in enumerate(self._trees, 1):
            try:
                yield LocatedMessage(_trees(stamp, cell), number, "trees")
            except MessageError as error:
                self._reject("trees", number, error)

    def _reject(self, stream: str, number: int, why: object) -> None:
        self._problems.add(f"malformed {stream}", f"{self.path}:{number}: {stream}: {why}; dropped")

    def _close(self) -> None:
        self._wheels = self._fixes = np.empty((0, 3))
        self._trees = []

    def streams(self) -> list[Stream]:
        """Return wheels, trees, and the GPS if there is one."""
        n, fixes = len(self._wheels), len(self._fixes)
        found = [
            Stream("wheels", "Steering", n, True, "u: speed and steering", default=True),
            Stream("trees", "Detections", len(self._trees), True, "zt", default=True),
        ]
        if fixes:
            note = f"Lo_m, La_m: {GPS_NOTE}"
            found.append(Stream("GPS", "TruePose", fixes, used=False, note=note))
        return found


def _check(path: Path, columns: dict[str, Array], *names: str) -> None:
    same_length(path, **{name: columns[name] for name in names})


def _table(path: Path, values: Any, name: str) -> Array:
    array: npt.NDArray[Any] = values[name]
    if array.dtype.kind not in "fiu" or array.ndim != 2:
        raise SourceError(f"{path}: {name} is not a table of numbers; copy it again")
    return array.astype(np.float64)


def _used(numbers: Ints, every: int) -> Mask:
    """Return which fixes, given their numbers, a sensor reads: every `every`-th."""
    return np.asarray((numbers % every == 0) if every else np.zeros(numbers.shape, np.bool_))


def _fix(row: Array, used: bool) -> TruePose | Fix:
    stamp, x, y = row.tolist()
    check_finite("stamp or position", stamp, x, y)
    if used:
        return Fix(float(stamp), np.array([x, y]), np.full((2, 2), math.nan))
    return TruePose(float(stamp), np.array([x, y, math.nan]))


def _steering(stamp: float, speed: float, angle: float) -> Steering:
    check_finite("stamp, speed or steering", stamp, speed, angle)
    return Steering(float(stamp), float(speed), float(angle))


def _scan(stamp: float, ranges: Array, echoes: Array) -> LaserScan:
    check_finite("stamp", stamp)
    n = len(ranges)
    angles = beam_angles(n, RIGHT, STEP)
    return LaserScan(
        float(stamp), angles, ranges, beam_times(n), range_max=RANGE_MAX, intensities=echoes
    )


def _trees(stamp: float, cell: Any) -> Detections:
    check_finite("stamp", stamp)
    rows = np.asarray(cell)
    if rows.dtype.kind not in "fiu" or (rows.size and (rows.ndim != 2 or len(rows) != 3)):
        raise MessageError(f"detections of shape {rows.shape} instead of three rows")
    ranges, bearings, diameters = rows.astype(np.float64).reshape(3, -1)
    labels = np.full(len(ranges), -1, np.int64)
    return Detections(stamp, ranges, bearings + RIGHT, labels, diameters)
