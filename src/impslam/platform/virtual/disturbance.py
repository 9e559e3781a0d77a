"""Noise and delays on one direction of a line."""

from __future__ import annotations

from collections import Counter
from typing import Literal, TypeAlias

import numpy as np

Kind: TypeAlias = Literal["flip", "drop", "insert", "any"]
KINDS = ("flip", "drop", "insert")
MAX_HELD = 1 << 20  # bytes that a stalled line holds back; more than it carries during any fault


class Disturbance:
    """Corrupts or holds back the bytes on one direction of a line.

    Parameters
    ----------
    rng : of the noise
    counts : counts corrupted bytes by `KINDS`, and lost ones as "overrun"
    """

    def __init__(self, rng: np.random.Generator, counts: Counter[str]) -> None:
        self._rng, self._counts = rng, counts
        self._rate, self._kind, self._noisy_until = 0.0, "any", 0.0
        self._held_until, self._held = 0.0, bytearray()

    def noise(self, rate: float, kind: Kind, until: float) -> None:
        """Corrupt a share of the bytes until a time, s."""
        self._rate, self._kind, self._noisy_until = rate, kind, until

    def hold(self, until: float) -> None:
        """Hold back all bytes until a time, s."""
        self._held_until = until

    def clear(self) -> None:
        """Drop the bytes held back."""
        self._held.clear()

    def transfer(self, data: bytes, time: float) -> bytes:
        """Send `data` into the line at a time, and return what comes out of it."""
        if data and time < self._noisy_until:
            data = self._corrupt(data)
        if time < self._held_until:
            self._counts["overrun"] += max(0, len(self._held) + len(data) - MAX_HELD)
            self._held += data[: MAX_HELD - len(self._held)]
            return b""
        if self._held:
            data = bytes(self._held) + data
            self._held.clear()
        return data

    def _corrupt(self, data: bytes) -> bytes:
        positions = np.flatnonzero(self._rng.random(len(data)) < self._rate)
        corrupted = bytearray(data)
        for position in positions[::-1].tolist():  # from the end, so that earlier ones stay valid
            kind = self._kind if self._kind != "any" else KINDS[self._rng.integers(len(KINDS))]
            self._counts[kind] += 1
            if kind == "flip":
                corrupted[position] ^= 1 << int(self._rng.integers(8))
            elif kind == "drop":
                del corrupted[position]
            else:
                corrupted.insert(position, int(self._rng.integers(256)))
        return bytes(corrupted)
