"""What a satellite receiver says in NMEA 0183, put together to fixes.

A receiver sends several sentences for each moment, in an order of its own: GGA (place, quality, HDOP), RMC
(whether it is valid) and GST (the errors' ellipse) are read here, whichever constellation's talker says
them. Sentences with one time make one epoch; it is complete once all kinds have come that the epoch
before had, or when the next one begins. Sentences are decoded by pynmeagps (BSD-3-Clause).
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

LONGEST = 1024  # bytes without a line's end: not NMEA, whose sentences have 82
KINDS = ("GGA", "RMC", "GST")
DAY = 86400.0  # s

# m: error of one range, 1 sigma, by GGA's quality. 1: 3.6 m of signals (GPS SPS Performance Standard, 5th
# ed., 2020: 7.0 m at 95 %) and 3.5 m of reflections and receiver. 2: the same reflections in the mean
# of several ranges, signals corrected. 4 and 5: carrier phase with ambiguities fixed, and not. Others
# (0 none, 6 dead reckoning, 7 typed in, 8 simulated) are no fixes.
RANGE_ERROR = {"1": 5.0, "2": 1.5, "3": 5.0, "4": 0.02, "5": 0.4}
_STATUS = {"1": FIX, "2": SATELLITES, "3": FIX, "4": GROUND, "5": GROUND}
_UP = 1.5  # 1, vertical error over horizontal: satellites are above only (VDOP / HDOP, usual sky)


class Epoch(NamedTuple):
    """A fix as the receiver tells it; see `types.SatelliteFix`.

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
class _Gathered:
    arrived: float
    sentences: dict[str, Any] = field(default_factory=dict)
    given: bool = False


class Sentences:
    """Lines with right checksums out of bytes that come in pieces.

    Parameters
    ----------
    library : pynmeagps
    count : told what was wrong, and how often
    """

    def __init__(self, library: ModuleType, count: Callable[[str, int], None]) -> None:
        self._library, self._count = library, count
        self._rest, self._began = b"", math.nan
        self._whole = False  # what comes before the first line's end may have begun earlier

    def feed(self, data: bytes, arrived: float) -> Iterator[tuple[Any, float]]:
        """Yield the sentences that these bytes complete, and when (s) each began to arrive.

        `arrived` is when the first of these bytes came.
        """
        if not self._rest:
            self._began = arrived
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:
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
        except Exception as error:  # also ValueError and others, of fields that are no numbers
            wrong = "checksum" if "checksum" in str(error) else "refused"
            self._count("corrupt" if wrong == "checksum" else wrong, 1)
        else:
            if sentence is None:
                self._count("refused", 1)
            else:
                yield sentence


class Epochs:
    """Fixes out of sentences."""

    def __init__(self) -> None:
        self._expected: frozenset[str] = frozenset()
        self._gathered: _Gathered | None = None
        self._moment: time | None = None
        self._days, self._last = 0, -math.inf

    def add(self, sentence: Any, arrived: float) -> Iterator[Epoch]:
        """Take a sentence that began to arrive at a time (s); yield the epoch that it completes."""
        moment = sentence.time
        if not isinstance(moment, time):  # a receiver that has not found the time yet
            moment = None
        if self._gathered is None or moment is None or moment != self._moment:
            yield from self._finish()
            self._moment, self._gathered = moment, _Gathered(arrived)
        gathered = self._gathered
        gathered.sentences.setdefault(sentence.msgID, sentence)
        if moment is None or (self._expected and self._expected <= gathered.sentences.keys()):
            yield from self._give(gathered)

    def _finish(self) -> Iterator[Epoch]:
        """Close the epoch: what it had is what the next one is expected to have."""
        if self._gathered is not None:
            self._expected = frozenset(self._gathered.sentences)
            yield from self._give(self._gathered)

    def _give(self, gathered: _Gathered) -> Iterator[Epoch]:
        if gathered.given:
            return  # a sentence that came after the epoch had been given out
        gathered.given = True
        found = _epoch(gathered, self._seconds(self._moment))
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


def _epoch(gathered: _Gathered, seconds: float) -> Epoch | None:
    """Return what the sentences of one moment tell; None if none of them tells a place or its lack."""
    sentences = gathered.sentences
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
    covariance = _of_ellipse(gst) if gst else None
    if covariance is None:
        covariance = _of_hdop(_number(gga.HDOP) if gga else math.nan, quality)
    if status == NO_FIX:
        covariance = np.full((3, 3), math.nan)
    return Epoch(seconds, gathered.arrived, latitude, longitude, height, covariance, status)


def _of_ellipse(gst: Any) -> Array | None:
    """Return the covariance of GST: of its ellipse, or of its errors along north and east."""
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


def _of_hdop(hdop: float, quality: str) -> Array:
    """Return the covariance by HDOP: sqrt(east^2 + north^2) of a range's error (Kaplan, 7.3.2)."""
    error = RANGE_ERROR.get(quality, math.nan)
    if not 0.0 < hdop < 99.0:  # receivers say 99.99 where they know none
        return np.full((3, 3), math.nan)
    side = hdop * error / math.sqrt(2.0)
    return np.diag([side, side, _UP * math.sqrt(2.0) * side]) ** 2


def _number(value: object) -> float:
    """Return a field as a number, NaN where it is empty."""
    try:
        return float(value)  # type: ignore[arg-type]  # an empty string, or None
    except (TypeError, ValueError):
        return math.nan
