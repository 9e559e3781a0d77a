"""Combine the NMEA 0183 sentences of a satellite receiver to fixes.

A receiver sends several sentences for each time, in any order. GGA (position, quality, HDOP), RMC
(validity) and GST (error ellipse) are used, from any constellation. Sentences with the same time make
one epoch; it is complete once it has all kinds of the epoch before, or when the next one begins.
Sentences are decoded by pynmeagps (BSD-3-Clause).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import time
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from impslam.types import FIX, GROUND, NO_FIX, SATELLITES, Array

MAX_LINE_LENGTH = 1024  # bytes; sentences of NMEA have at most 82
KINDS = ("GGA", "RMC", "GST")
DAY = 86400.0  # s

# m: error of one range, 1 sigma, by GGA's quality. 1: 3.6 m of signals (GPS SPS Performance Standard, 5th
# ed., 2020: 7.0 m at 95 %) and 3.5 m of reflections and receiver. 2: the same reflections in the mean
# of several ranges, signals corrected. 4 and 5: carrier phase with ambiguities fixed, and not. Others
# (0 none, 6 dead reckoning, 7 manual, 8 simulated) are not fixes.
RANGE_ERROR = {"1": 5.0, "2": 1.5, "3": 5.0, "4": 0.02, "5": 0.4}
_STATUS = {"1": FIX, "2": SATELLITES, "3": FIX, "4": GROUND, "5": GROUND}
_VERTICAL_RATIO = 1.5  # 1, VDOP / HDOP of a usual sky: satellites are only above the receiver


class Epoch(NamedTuple):
    """A fix of the receiver; see `types.SatelliteFix`.

    Attributes
    ----------
    seconds : of the day (UTC), unwrapped over midnight
    arrived : s on the host's clock, when its first sentence began
    """

    seconds: float
    arrived: float
    latitude: float
    longitude: float
    altitude: float
    covariance: Array
    status: int


@dataclass(slots=True)
class _PartialEpoch:
    arrived: float
    sentences: dict[str, Any] = field(default_factory=dict)
    delivered: bool = False


class Sentences:
    """Splits pieces of a byte stream into sentences with correct checksums.

    Parameters
    ----------
    library : pynmeagps
    count : called with a counter of errors and an increment
    """

    def __init__(self, library: ModuleType, count: Callable[[str, int], None]) -> None:
        self._library, self._count = library, count
        self._rest, self._began = b"", math.nan
        self._whole = False  # the first line may be cut

    def feed(self, data: bytes, arrived: float) -> Iterator[tuple[Any, float]]:
        """Yield the sentences that these bytes complete, and the arrival of their first byte, s.

        `arrived` is the arrival of the first of these bytes.
        """
        if not self._rest:
            self._began = arrived
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_LENGTH:
            self._rest = b""
            self._count("not NMEA", 1)
        for line in lines:
            start = line.rfind(b"$")
            if start < 0 or b"*" not in line[start:]:
                self._count("cut", int(self._whole and bool(line.strip())))
            else:
                for sentence in self._parsed(line[start:].strip() + b"\r\n"):
                    yield sentence, self._began
            self._whole, self._began = True, arrived

    def _parsed(self, line: bytes) -> Iterator[Any]:
        if line[3:6].decode("ascii", "replace") not in KINDS:
            self._count("other sentences", 1)
            return
        try:
            sentence = self._library.NMEAReader.parse(line)
        except Exception as error:  # also ValueError and others, of invalid fields
            wrong = "checksum" if "checksum" in str(error) else "refused"
            self._count("corrupt" if wrong == "checksum" else wrong, 1)
        else:
            if sentence is None:
                self._count("refused", 1)
            else:
                yield sentence


class Epochs:
    """Combines sentences to epochs."""

    def __init__(self) -> None:
        self._expected: frozenset[str] = frozenset()
        self._partial: _PartialEpoch | None = None
        self._moment: time | None = None
        self._days, self._last = 0, -math.inf

    def add(self, sentence: Any, arrived: float) -> Iterator[Epoch]:
        """Add a sentence and the arrival of its first byte, s; yield the epochs that it completes."""
        moment = sentence.time
        if not isinstance(moment, time):  # the receiver does not know the time yet
            moment = None
        if self._partial is None or moment is None or moment != self._moment:
            yield from self._finish()
            self._moment, self._partial = moment, _PartialEpoch(arrived)
        partial = self._partial
        partial.sentences.setdefault(sentence.msgID, sentence)
        if moment is None or (self._expected and self._expected <= partial.sentences.keys()):
            yield from self._emit(partial)

    def _finish(self) -> Iterator[Epoch]:
        """Close the epoch; the next one is expected to have the same kinds of sentences."""
        if self._partial is not None:
            self._expected = frozenset(self._partial.sentences)
            yield from self._emit(self._partial)

    def _emit(self, partial: _PartialEpoch) -> Iterator[Epoch]:
        if partial.delivered:
            return  # a sentence after the end of its epoch
        partial.delivered = True
        found = _epoch(partial, self._seconds(self._moment))
        if found is not None:
            yield found

    def _seconds(self, moment: time | None) -> float:
        if moment is None:
            return math.nan
        second = moment.second + 1e-6 * moment.microsecond
        of_day = 3600.0 * moment.hour + 60.0 * moment.minute + second
        if of_day < self._last - 0.5 * DAY:
            self._days += 1
        self._last = of_day
        return of_day + DAY * self._days


def _epoch(partial: _PartialEpoch, seconds: float) -> Epoch | None:
    """Return the fix in the sentences of one time; None without GGA and RMC."""
    sentences = partial.sentences
    gga, rmc, gst = (sentences.get(kind) for kind in KINDS)
    place = gga or rmc
    if place is None:
        return None
    quality = str(gga.quality if gga else int(place.status == "A"))
    status = _STATUS.get(quality, NO_FIX)
    latitude, longitude = _number(place.lat), _number(place.lon)
    if (rmc is not None and rmc.status != "A") or not math.isfinite(latitude + longitude):
        status = NO_FIX
    if status == NO_FIX:
        latitude = longitude = math.nan
    height = _number(gga.alt) + _number(gga.sep) if gga else math.nan
    covariance = _gst_covariance(gst) if gst else None
    if covariance is None:
        covariance = _hdop_covariance(_number(gga.HDOP) if gga else math.nan, quality)
    if status == NO_FIX:
        covariance = np.full((3, 3), math.nan)
    return Epoch(seconds, partial.arrived, latitude, longitude, height, covariance, status)


def _gst_covariance(gst: Any) -> Array | None:
    """Return the covariance of GST, from its ellipse, or else from its errors north and east."""
    major, minor, angle = (_number(v) for v in (gst.stdMajor, gst.stdMinor, gst.orient))
    north, east, up = (_number(v) for v in (gst.stdLat, gst.stdLong, gst.stdAlt))
    covariance = np.diag([east**2, north**2, up**2])
    if math.isfinite(major + minor + angle) and minor > 0.0:
        axis = np.array(
            [math.sin(math.radians(angle)), math.cos(math.radians(angle))]
        )  # from north
        along = np.outer(axis, axis)
        covariance[:2, :2] = major**2 * along + minor**2 * (np.eye(2) - along)
    sound = np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all()
    return covariance if sound else None


def _hdop_covariance(hdop: float, quality: str) -> Array:
    """Return the covariance by HDOP: sqrt(east^2 + north^2) per range error (Kaplan, 7.3.2)."""
    error = RANGE_ERROR.get(quality, math.nan)
    if not 0.0 < hdop < 99.0:  # receivers send 99.99 if it is unknown
        return np.full((3, 3), math.nan)
    side = hdop * error / math.sqrt(2.0)
    return np.diag([side, side, _VERTICAL_RATIO * math.sqrt(2.0) * side]) ** 2


def _number(value: object) -> float:
    """Return a field as a number, NaN if it is empty."""
    try:
        return float(value)  # type: ignore[arg-type]  # an empty string, or None
    except (TypeError, ValueError):
        return math.nan
