"""Folder of a UTIAS Multi-Robot Cooperative Localization and Mapping data set (Leung et al. 2011).

Five robots with a monocular camera drive among landmarks with barcodes; one robot's log is read:

    RobotN_Odometry.dat        t v omega              speed and turn rate as commanded
    RobotN_Measurement.dat     t barcode range bearing
    Barcodes.dat               subject barcode        subjects 1 to 5 are robots, the others landmarks
    RobotN_Groundtruth.dat     t x y theta            motion capture, for scoring
    Landmark_Groundtruth.dat   subject x y ...        likewise

Rows of one picture have stamps up to some milliseconds apart and form one message; pictures are 0.2 s
apart. A landmark's label is its subject. Detections of the other robots are left out, because they move.
Unknown barcodes are misreadings.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from impslam.columns import Columns
from impslam.component import parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources.base import Stream
from impslam.sources.parts import LocatedMessage, Piece, merge_order, single
from impslam.sources.tables import Lines
from impslam.sources.text import TextSource, head, numbers
from impslam.types import Array, Detections, Ints, TrueLandmark, TruePose, Velocity

ROBOTS = 5  # subjects 1 to 5 are robots
PICTURE = 0.02  # s, maximum time between rows of one picture; a tenth of the camera's period
_FILE = re.compile(r"Robot(\d+)_(Odometry|Measurement|Groundtruth)\.dat")
_MAX_VALUE = 1e12  # the largest valid numbers are stamps
_COLUMNS = {"Odometry": 3, "Measurement": 4, "Groundtruth": 4}


@register("mrclam")
class Mrclam(TextSource):
    """Folder of an MRCLAM data set, or a file of one of its robots."""

    default_preset: ClassVar[str] = "mrclam"

    robot: int = parameter(
        0, "", "robot whose log to read; 0: the one whose file is given, or else the first", ge=0
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by a robot's odometry and measurements with the right number of columns."""
        folder, _ = _split(path)
        return (path.is_dir() or _FILE.fullmatch(path.name) is not None) and bool(_robots(folder))

    @cached_property
    def _number(self) -> int:
        """The robot to read; cached, because `total` is read after each batch."""
        folder, named = _split(self.path)
        robots = _robots(folder)
        number = self.robot or named or (robots[0] if robots else 0)
        if number not in robots:
            available = ", ".join(map(str, robots)) or "none"
            raise SourceError(
                f"{self.path}: no odometry and measurements of robot {number}; available: "
                f"{available}; choose one with --set source.robot=N"
            )
        return number

    def _file(self, what: str) -> Path:
        return _split(self.path)[0] / f"Robot{self._number}_{what}.dat"

    def _files(self) -> list[Path]:
        own = [self._file(what) for what in ("Odometry", "Measurement", "Groundtruth")]
        existing = own if own[2].is_file() else own[:2]
        return [*existing, _split(self.path)[0] / "Barcodes.dat"]

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield all rows; the files have some MB and are merged by their stamps."""
        del rows
        odometry, measurement, *truth, barcodes = self._files()
        subjects = {int(row[1]): int(row[0]) for row in self._table(barcodes, 2)[1]}
        wheels = self._table(odometry, 3)
        pictures = list(self._pictures(measurement, subjects))
        tracked = self._table(truth[0], 4) if truth else (np.empty(0, np.int64), np.empty((0, 4)))
        seen = np.array([picture.message.stamp for picture in pictures])
        orders = merge_order(wheels[1][:, 0], seen, tracked[1][:, 0])
        part = [single(*picture) for picture in zip(pictures, orders[1].tolist(), strict=True)]
        stamp, speed, turn_rate = wheels[1].T.copy()
        motion = {"stamp": stamp, "speed": speed, "turn_rate": turn_rate}
        part.append(Piece.of(Columns(odometry.name, Velocity, orders[0], motion, {}), wheels[0]))
        for path in truth:
            poses = {"stamp": tracked[1][:, 0].copy(), "pose": tracked[1][:, 1:].copy()}
            columns = Columns(path.name, TruePose, orders[2], poses, {})
            part.append(Piece.of(columns, tracked[0]))
        yield [piece for piece in part if len(piece.columns)]

    def _pictures(self, path: Path, subjects: dict[int, int]) -> Iterator[LocatedMessage]:
        """Yield the detections of each picture that shows landmarks."""
        seen: list[Array] = []
        first = 0
        for number, row in zip(*self._table(path, 4), strict=True):
            label = self._landmark(path, number, row, subjects)
            if label is None:
                continue
            row[1] = label
            if seen and not 0.0 <= row[0] - seen[0][0] < PICTURE:
                yield LocatedMessage(
                    _detections(np.array(seen)), int(first), path.name, checked=False
                )
                seen = []
            if not seen:
                first = number
            seen.append(row)
        if seen:
            yield LocatedMessage(_detections(np.array(seen)), int(first), path.name, checked=False)

    def _landmark(
        self, path: Path, number: int, row: Array, subjects: dict[int, int]
    ) -> int | None:
        """Return the detected subject, or None if it is not a landmark."""
        subject = subjects.get(int(row[1]))
        if subject is None:
            self._problems.add(
                "unknown barcode",
                f"{path}:{number}: barcode {row[1]:g} is not in Barcodes.dat, so it was misread; "
                "the detection is dropped",
            )
        return None if subject is None or subject <= ROBOTS else subject

    def _table(self, path: Path, columns: int) -> tuple[Ints, Array]:
        """Return the valid rows of a file: line numbers (m,) and values (m, columns)."""
        places, tables = [np.empty(0, np.int64)], [np.empty((0, columns))]
        for first, block in self._blocks(path):
            lines = Lines(block)
            values, good = lines.table(np.arange(len(lines)), 0, columns, 0)
            good &= (np.abs(values) < _MAX_VALUE).all(axis=1)
            for k in np.flatnonzero(~good).tolist():
                line = lines.line(k)
                if line.startswith(b"#") or not line.strip():
                    continue
                try:
                    values[k], good[k] = _row(line, columns), True
                except (ValueError, MessageError) as error:
                    self._reject(f"{path.stem} line", path, first + k, error)
            places.append(first + np.flatnonzero(good))
            tables.append(values[good])
        return np.concatenate(places), np.concatenate(tables)

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the surveyed landmarks, in the frame of the motion capture."""
        path = _split(self.path)[0] / "Landmark_Groundtruth.dat"
        rows = self._table(path, 5)[1] if path.is_file() else np.empty((0, 5))
        self._open.pop(path, None)  # not part of the log for its progress
        return [TrueLandmark(str(int(row[0])), "point", row[1:3], {}) for row in rows]

    def streams(self) -> list[Stream]:
        """Return the files of the robot in use, and the other robots."""
        folder, chosen = _split(self.path)[0], self._number
        types = {"Odometry": "Velocity", "Measurement": "Detections", "Groundtruth": "TruePose"}
        notes = {
            "Odometry": "commanded",
            "Measurement": "rows; those of robots are left out",
            "Groundtruth": "only for scoring",
        }
        found = []
        for what, kind in types.items():
            path = self._file(what)
            if path.is_file():
                counts = self._first_words(path)
                count = sum(n for word, n in counts.items() if word and not word.startswith("#"))
                used = what != "Groundtruth"
                found.append(Stream(path.name, kind, count, used, notes[what], default=used))
        for other in _robots(folder):
            if other != chosen:
                note = f"--set source.robot={other}"
                found.append(Stream(f"Robot{other}_*.dat", "text", None, used=False, note=note))
        return found


def _split(path: Path) -> tuple[Path, int]:
    """Return the folder of a data set and the number of the robot in the path's name, or 0."""
    named = _FILE.fullmatch(path.name)
    if path.is_dir() or named is None:
        return path, 0
    return path.parent, int(named[1])


def _robots(folder: Path) -> list[int]:
    """Return the numbers of the robots in a folder with odometry and measurements."""
    numbered = {int(m[1]) for p in folder.glob("Robot*.dat") if (m := _FILE.fullmatch(p.name))}
    return sorted(
        n
        for n in numbered
        if all(_has_columns(folder / f"Robot{n}_{what}.dat", what) for what in list(_COLUMNS)[:2])
    )


def _has_columns(path: Path, what: str) -> bool:
    """Return whether the first lines of a file, without comments, have the right number of columns."""
    lines = [line for line in head(path) if not line.startswith(b"#") and line.strip()]
    try:
        return bool(lines) and all(len(_row(line, _COLUMNS[what])) for line in lines[:3])
    except (ValueError, MessageError):
        return False


def _row(line: bytes, columns: int) -> Array:
    row = numbers(line.split())
    if len(row) != columns:
        raise MessageError(f"{len(row)} words instead of {columns}")
    if not (np.abs(row) < _MAX_VALUE).all():
        raise MessageError("a number is not finite or too large")
    return row


def _detections(rows: Array) -> Detections:
    """Return a picture's detections from rows (n, 4) of stamp, subject, range, bearing."""
    labels, nothing = rows[:, 1].astype(np.int64), np.full(len(rows), np.nan)
    return Detections(float(rows[0, 0]), rows[:, 2], rows[:, 3], labels, nothing)
