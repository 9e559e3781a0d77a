"""Folder of a LEGO robot with a small lidar, as used in Claus Brenner's SLAM lectures.

`*_motors.txt` contains `M t left(4) right(4) third(4)` with the ticks in the first word of each four,
`*_scan.txt` contains `S t n r0 ... r(n-1)`; times are in ms on one clock, ranges in mm.

The optional `*_reference.txt` contains the true positions as `P t x y`, and `*landmarks.txt` the cylinders
as `L C x y size`, in mm, in a separate frame.

The lectures pair the i-th M with the i-th S. But both are stamped on arrival, independently and at uneven
intervals: here each keeps its own stamps, and the files are merged by them. The delay of the scans is a
property of the robot (`latency` of its lidar).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import ClassVar

import numpy as np

from impslam.component import register
from impslam.errors import MessageError, SourceError
from impslam.sources.base import Stream
from impslam.sources.parts import LocatedMessage
from impslam.sources.text import TextSource, beam_angles, beam_times, check_finite, head, numbers
from impslam.sources.urg04lx import BEAM_TIME, RANGE_MIN, STEP
from impslam.types import Array, LaserScan, Message, TrueLandmark, TruePose, WheelAngles

MOUNT = math.radians(-4.0)  # rad; the format's beam angles include the rotation of the mount
START = -330.0 * STEP + MOUNT
SCORING = "only for scoring"


@register("lego")
class Lego(TextSource):
    """Folder of a LEGO robot: *_motors.txt (ticks) and *_scan.txt."""

    default_preset: ClassVar[str] = "lego-robot4"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by a pair of files whose lines start with M and S."""
        return path.is_dir() and bool(_runs(path))

    def _files(self) -> list[Path]:
        runs = _runs(self.path)
        if not runs:
            raise SourceError(f"{self.path}: no *_motors.txt with a *_scan.txt; check the folder")
        motors, scans = runs[0]
        reference = motors.with_name(motors.name.replace("_motors.txt", "_reference.txt"))
        return [motors, scans, *([reference] if reference.is_file() else [])]

    def _messages(self) -> Iterator[LocatedMessage]:
        motors, scans, *reference = self._files()
        wheels = self._read(motors, b"M", _wheels)
        sweeps = self._read(scans, b"S", self._scan)
        # Lines are not sorted within a file; the merge only interleaves the files.
        truth = (self._read(path, b"P", _position, checked=False) for path in reference)
        yield from heapq.merge(wheels, sweeps, *truth, key=attrgetter("message.stamp"))

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the cylinders in the folder."""
        centres = []
        for path in sorted(self.path.glob("*landmarks.txt")):
            for number, line in self._lines(path):
                if (tokens := line.split())[:2] != [b"L", b"C"]:
                    continue
                try:
                    centres.append(_centre(tokens))
                except (ValueError, MessageError) as error:
                    self._reject("L line", path, number, error)
        return [
            TrueLandmark(f"cylinder {number}", "cylinder", centre, {})
            for number, centre in enumerate(centres, 1)
        ]

    def _read(
        self,
        path: Path,
        tag: bytes,
        convert: Callable[[list[bytes]], Message],
        checked: bool = True,
    ) -> Iterator[LocatedMessage]:
        for number, line in self._lines(path):
            tokens = line.split()
            if not tokens:
                continue
            try:
                message = convert(_tagged(tokens, tag))
            except (ValueError, IndexError, MessageError) as error:
                self._reject(f"{tag.decode()} line", path, number, error)
            else:
                yield LocatedMessage(message, number, path.name, checked=checked)

    def _scan(self, tokens: list[bytes]) -> LaserScan:
        n = int(tokens[2])
        if n <= 0 or len(tokens) != n + 3:
            raise MessageError(f"{len(tokens)} words, which does not match {n} ranges")
        stamp = float(tokens[1]) / 1000.0
        check_finite("stamp", stamp)
        ranges = numbers(tokens[3:]) / 1000.0
        angles, times = beam_angles(n, START, STEP), beam_times(n, BEAM_TIME)
        return LaserScan(stamp, angles, ranges, times, range_min=RANGE_MIN)

    def streams(self) -> list[Stream]:
        """Return the files of the run in use, and other files in the folder."""
        motors, scans, *_ = self._files()
        found = [
            Stream(
                motors.name,
                "WheelAngles",
                self._first_words(motors)["M"],
                True,
                "ticks",
                default=True,
            ),
            Stream(scans.name, "LaserScan", self._first_words(scans)["S"], True, default=True),
        ]
        for path in sorted(self.path.glob("*_reference.txt")):
            count = self._first_words(path)["P"]
            found.append(Stream(path.name, "TruePose", count, used=False, note=SCORING))
        for path in sorted(self.path.glob("*landmarks.txt")):
            count = self._first_words(path)["L"]
            found.append(Stream(path.name, "cylinders", count, used=False, note=SCORING))
        for run in _runs(self.path)[1:]:
            found += [Stream(p.name, "text", None, used=False, note="another run") for p in run]
        return found


def _centre(tokens: list[bytes]) -> Array:
    """Return the centre (2,) m of a cylinder."""
    if len(tokens) < 4:
        raise MessageError("x or y is missing")
    centre = 1e-3 * numbers(tokens[2:4])
    check_finite("centre", *centre)
    return centre


def _tagged(tokens: list[bytes], tag: bytes) -> list[bytes]:
    if tokens[0] != tag:
        raise MessageError(f"the line does not start with {tag.decode()}")
    return tokens


def _wheels(tokens: list[bytes]) -> WheelAngles:
    stamp, left, right = float(tokens[1]) / 1000.0, float(tokens[2]), float(tokens[6])
    check_finite("stamp or ticks", stamp, left, right)
    return WheelAngles(stamp, left, right)


def _position(tokens: list[bytes]) -> TruePose:
    stamp, x, y = (float(token) / 1000.0 for token in tokens[1:4])
    check_finite("stamp or position", stamp, x, y)
    return TruePose(stamp, np.array([x, y, math.nan]))


def _runs(folder: Path) -> list[tuple[Path, Path]]:
    """Return the pairs of (motors, scan) files in a folder, matched by name."""
    pairs = [
        (motors, motors.with_name(motors.name.replace("_motors.txt", "_scan.txt")))
        for motors in sorted(folder.glob("*_motors.txt"))
    ]
    return [pair for pair in pairs if _opens(pair[0], b"M ") and _opens(pair[1], b"S ")]


def _opens(path: Path, tag: bytes) -> bool:
    return any(line.startswith(tag) for line in head(path)[:3])
