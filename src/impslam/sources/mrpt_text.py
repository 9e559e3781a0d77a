"""Text exports of rawlogs of the Mobile Robot Programming Toolkit: increments and detections.

    ODOINC t dx dy dphi ...                        motion since the line before, on the robot
    BR t sx sy sphi n (id range yaw pitch) * n     detections of a range-bearing sensor at [sx, sy, sphi]

Stamps of simulated rawlogs are meaningless (all equal, or 0): a step is an increment with the detections
after it, and step k is stamped k seconds here. Increments are accumulated to odometry poses.

Beside `NAME.txt` a simulator may write `NAME_ground_truth_robot_path.txt`, whose row k is the pose
(x y z yaw pitch roll) of the k-th detections, and `NAME_ground_truth.txt` with the landmarks (x y z first,
id last). If they exist, they are read for scoring.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np

from impslam.component import register
from impslam.errors import MessageError
from impslam.geometry.se2 import compose
from impslam.sources.base import Stream
from impslam.sources.parts import LocatedMessage
from impslam.sources.text import DAMAGE, TextSource, check_finite, head, numbers, open_text
from impslam.types import Array, Detections, OdometryPose, TrueLandmark, TruePose

_MIN_INCREMENT_WORDS = 5  # of an ODOINC: name, t, dx, dy, dphi
_HEAD_WORDS = 6  # of a BR before its first detection
_MAX_INCREMENT = 1e6  # m and rad, beyond any step of a robot
_DETECTION_WORDS = 4  # id, range, yaw, pitch
_OBJECTS = b"CSensoryFrame", b"CObservation", b"CActionCollection"
"""Names of the objects that a rawlog contains."""
_START = 256  # bytes that contain the first of them


@register("mrpt_text")
class MrptText(TextSource):
    """Text export of an MRPT rawlog: ODOINC and BR lines."""

    default_preset: ClassVar[str] = "kf-demo"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by the first lines, without comments."""
        lines = [line for line in head(path) if not line.startswith(b"#")][:4]
        return any(_plausible(line.split()) for line in lines)

    @classmethod
    def explain_refusal(cls, path: Path) -> str:
        """Say how to export a rawlog, which is binary."""
        start = _start(path)
        if not any(name in start for name in _OBJECTS):
            return ""
        return (
            "it is a binary rawlog of MRPT: export it with rawlog-edit --export-2d-scans-txt and "
            "--export-odometry-txt and write the result as CSV, or write landmarks as lines ODOINC and BR "
            "(docs/formats.md)"
        )

    def _messages(self) -> Iterator[LocatedMessage]:
        stamp, pose = 0.0, np.zeros(3)
        truth = self._true_poses()
        yield LocatedMessage(OdometryPose(stamp, pose), 1, "ODOINC")
        for number, line in self._lines(self.path):
            tokens = line.split()
            try:
                if tokens[:1] == [b"ODOINC"]:
                    stamp += 1.0
                    pose = compose(pose, _increment(tokens))
                    yield LocatedMessage(OdometryPose(stamp, pose), number, "ODOINC")
                elif tokens[:1] == [b"BR"]:
                    true = next(truth, None)
                    if true is not None:
                        yield LocatedMessage(
                            TruePose(stamp, true), number, self._true_path.name, checked=False
                        )
                    yield LocatedMessage(_detections(stamp, tokens), number, "BR")
                elif tokens and not _is_name(tokens[0]):
                    self._reject("line", self.path, number, "it does not start with a record name")
            except (ValueError, OverflowError, IndexError, MessageError) as error:
                self._reject(tokens[0].decode(), self.path, number, error)

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the landmarks of the file beside the log, by their ids."""
        rows = self._rows(self._beside("ground_truth"), 4)
        return [TrueLandmark(str(int(row[-1])), "point", row[:2], {}) for row in rows]

    def _true_poses(self) -> Iterator[Array]:
        """Yield the true poses (3,), one for each BR."""
        for row in self._rows(self._true_path, 6):
            yield row[[0, 1, 3]]

    @property
    def _true_path(self) -> Path:
        return self._beside("ground_truth_robot_path")

    def _beside(self, what: str) -> Path:
        name = self.path.name.removesuffix(".gz").removesuffix(".txt")
        return self.path.with_name(f"{name}_{what}.txt")

    def _rows(self, path: Path, min_words: int) -> Iterator[Array]:
        """Yield the rows of numbers of an optional file."""
        if not path.is_file():
            return
        for number, line in self._lines(path):
            if line.startswith((b"%", b"#")) or not line.strip():
                continue
            try:
                row = _truth(line, min_words)
            except (ValueError, MessageError) as error:
                self._reject("truth", path, number, error)
                continue
            yield row

    @property
    def position(self) -> int:
        """Number of bytes read from the log, without the truth beside it."""
        raw = self._open.get(self.path)
        if raw is None:
            return 0
        return self.path.stat().st_size if raw.closed else raw.tell()

    def streams(self) -> list[Stream]:
        """Return the kinds of record, by name, and the files of the truth."""
        found = [
            Stream(
                name,
                _TYPES.get(name, "text"),
                count,
                name in _TYPES,
                self._note(name),
                name in _TYPES,
            )
            for name, count in sorted(self._first_words(self.path).items())
            if _is_name(name.encode())
        ]
        for what in ("ground_truth_robot_path", "ground_truth"):
            path = self._beside(what)
            if path.is_file():
                found.append(Stream(path.name, "truth", None, used=False, note="only for scoring"))
        return found

    def _note(self, name: str) -> str:
        return {
            "ODOINC": "increments; step k is stamped k seconds",
            "BR": "range and bearing to landmarks",
        }.get(name, "")


_TYPES = {"ODOINC": "OdometryPose", "BR": "Detections"}


def _is_name(word: bytes) -> bool:
    """Return whether a word may be the name of a record or start a comment."""
    return word.startswith(b"#") or (word.isalpha() and word.isupper())


def _plausible(tokens: list[bytes]) -> bool:
    if tokens[:1] == [b"ODOINC"]:
        return len(tokens) >= _MIN_INCREMENT_WORDS
    return tokens[:1] == [b"BR"] and len(tokens) >= _HEAD_WORDS


def _truth(line: bytes, min_words: int) -> Array:
    row = numbers(line.split())
    if len(row) < min_words:
        raise MessageError(f"{len(row)} words instead of {min_words}")
    check_finite("the truth", *row)
    return row


def _increment(tokens: list[bytes]) -> Array:
    if len(tokens) < _MIN_INCREMENT_WORDS:
        raise MessageError(f"{len(tokens)} words instead of {_MIN_INCREMENT_WORDS} or more")
    increment = numbers(tokens[2:5])
    if not (np.abs(increment) < _MAX_INCREMENT).all():
        raise MessageError("an increment is not finite or too large")
    return increment


def _detections(stamp: float, tokens: list[bytes]) -> Detections:
    n = int(tokens[5])
    if n < 0 or len(tokens) != _HEAD_WORDS + _DETECTION_WORDS * n:
        raise MessageError(f"{len(tokens)} words, which does not match {n} detections")
    table = numbers(tokens[_HEAD_WORDS:]).reshape(n, _DETECTION_WORDS)
    with np.errstate(invalid="ignore"):
        ranges = table[:, 1] * np.cos(table[:, 3])  # in the plane
        labels = np.where(table[:, 0] >= 0.0, table[:, 0], -1.0)
    if not (table[:, 0] < _MAX_ID).all():  # false for NaN, too
        raise MessageError("an id is not a landmark number")
    return Detections(stamp, ranges, table[:, 2], labels.astype(np.int64), np.full(n, np.nan))


_MAX_ID = 2.0**53  # beyond it, float64 cannot represent all integers


def _start(path: Path) -> bytes:
    """Return the first bytes of a file, plain or gzipped; none of a folder or a damaged file."""
    try:
        with open_text(path) as (_, text):
            return text.read(_START)
    except DAMAGE:
        return b""
