"""The virtual GNSS receiver: sends NMEA 0183, in a world with a position on the earth.

Its errors are those of a receiver under open sky: white noise, and a slowly varying error (satellites'
orbits and clocks, atmosphere), a first-order Gauss-Markov process.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from impslam.geometry.geodesy import LocalPlane
from impslam.types import Array

RATE = 1.0  # Hz
WHITE, SHARED, CORRELATION_TIME = 0.5, 1.5, 300.0
"""m, m, s: per axis; together HDOP 1.0 of 2.2 m a range."""
DELAY = 0.1  # s from a fix to its sentences
ORIGIN = LocalPlane(52.0, 13.0, 40.0)  # of map; its x points east
START_TIME = 12 * 3600.0  # s of the day


class GpsEmulator:
    """A GNSS receiver as seen from its port.

    Parameters
    ----------
    pose : returns the true pose (3,)
    seed : of its errors
    """

    def __init__(self, pose: Callable[[], Array], seed: int = 0) -> None:
        self._pose = pose
        self._rng = np.random.default_rng(seed)
        self._shared = SHARED * self._rng.standard_normal(2)
        self._waiting: list[tuple[float, bytes]] = []
        self._next = 0.0
        self.sky = True  # without it there is no fix

    def receive(self, data: bytes, time: float) -> None:
        """Ignore bytes from the host."""

    def reboot(self, time: float) -> None:
        """Drop pending sentences; the next fix takes a second."""
        self._waiting.clear()
        self._next = math.floor(time) + 2.0 / RATE

    def due(self, time: float) -> bytes:
        """Return the bytes sent until `time`."""
        while time >= self._next:
            self._waiting.append((self._next + DELAY, self._sentences(self._next)))
            self._next += 1.0 / RATE
        out = b"".join(data for due, data in self._waiting if due <= time)
        self._waiting = [entry for entry in self._waiting if entry[0] > time]
        return out

    def _sentences(self, time: float) -> bytes:
        """Return RMC, GGA and GST of a fix."""
        correlation = math.exp(-1.0 / (RATE * CORRELATION_TIME))
        innovation = SHARED * math.sqrt(1.0 - correlation**2)
        self._shared = correlation * self._shared + innovation * self._rng.standard_normal(2)
        error = self._shared + WHITE * self._rng.standard_normal(2)
        place = ORIGIN.geodetic(np.array([*(self._pose()[:2] + error), 0.0]))
        moment = (START_TIME + time) % 86400.0
        clock = f"{int(moment // 3600):02}{int(moment // 60) % 60:02}{moment % 60:05.2f}"
        lat, lon = _degrees(place[0], "NS", 2), _degrees(place[1], "EW", 3)
        sigma = math.hypot(WHITE, SHARED)
        if not self.sky:
            rest = (f"GNRMC,{clock},V,,,,,,,010126,,,N", f"GNGGA,{clock},,,,,0,00,99.99,,,,,,")
            return b"".join(map(_sentence, rest))
        return b"".join(
            map(
                _sentence,
                (
                    f"GNRMC,{clock},A,{lat},{lon},,,010126,,,A",
                    f"GNGGA,{clock},{lat},{lon},1,09,1.0,{place[2] - 40.0:.1f},M,40.0,M,,",
                    f"GNGST,{clock},2.2,{sigma:.2f},{sigma:.2f},0.0,{sigma:.2f},{sigma:.2f},3.5",
                ),
            )
        )


def _degrees(value: float, letters: str, digits: int) -> str:
    """Return degrees in the format of NMEA: ddmm.mmmmm and a letter."""
    whole, minutes = divmod(round(abs(value) * 60.0, 5), 60.0)
    return f"{int(whole):0{digits}}{minutes:08.5f},{letters[value < 0]}"


def _sentence(text: str) -> bytes:
    check = 0
    for byte in text.encode("ascii"):
        check ^= byte
    return f"${text}*{check:02X}\r\n".encode("ascii")
