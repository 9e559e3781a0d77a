"""What noise and delays do to the bytes on one direction of a line."""

from __future__ import annotations

from collections import Counter
from typing import Literal, TypeAlias

import numpy as np

Kind: TypeAlias = Literal["flip", "drop", "insert", "any"]
KINDS = ("flip", "drop", "insert")
HELD = 1 << 20  # bytes that a stalled line holds back; more than it carries in any fault's time


class Disturbance:
    """What happens to the bytes on one direction of a line.

    Parameters
    ----------
    rng : of the noise
    counts : takes what was done to the bytes, under `KINDS` and "overrun"
    """

    def __init__(self, rng: np.random.Generator, counts: Counter[str]) -> None:
        self._rng, self._counts = rng, counts
        self._rate, self._kind, self._noisy_until = 0.0, "any", 0.0
        self._held_until, self._held = 0.0, bytearray()

    def noise(self, rate: float, kind: Kind, until: float) -> None:
        """Spoil a share of the bytes until a time in s."""
        self._rate, self._kind, self._noisy_until = rate, kind, until

    def hold(self, until: float) -> None:
        """Hold all bytes back until a time in s."""
        self._held_until = until

    def forget(self) -> None:
        """Lose the bytes that are being held back."""
        self._held.clear()

    def passed(self, data: bytes, time: float) -> bytes:
        """Return what comes out of the line at a time when `data` goes in."""
        if data and time < self._noisy_until:
            data = self._spoil(data)
        if time < self._held_until:
            self._counts["overrun"] += max(0, len(self._held) + len(data) - HELD)
            self._held += data[: HELD - len(self._held)]
            return b""
        if self._held:
            data = bytes(self._held) + data
            self._held.clear()
        return data

    def _spoil(self, data: bytes) -> bytes:
        places = np.flatnonzero(self._rng.random(len(data)) < self._rate)
        spoilt = bytearray(data)
        for place in places[::-1].tolist():  # from the end, so that places before stay valid
            kind = self._kind if self._kind != "any" else KINDS[self._rng.integers(len(KINDS))]
            self._counts[kind] += 1
            if kind == "flip":
                spoilt[place] ^= 1 << int(self._rng.integers(8))
            elif kind == "drop":
                del spoilt[place]
            else:
                spoilt.insert(place, int(self._rng.integers(256)))
        return bytes(spoilt)
