"""Lines between an emulator and the host, with faults.

Nothing here blocks: bytes that the host does not read are lost and counted, as on a UART.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque

import numpy as np

from impslam.platform.virtual.disturbance import Disturbance, Kind

CHUNK = 65536  # bytes read at once


class Line(ABC):
    """A line that can be unplugged and disturbed. Times are in s since the start of the virtual robot.

    Parameters
    ----------
    seed : of the noise on it
    baud : bit/s, ten bits per byte; 0: no delay, as nearly with USB and TCP

    Attributes
    ----------
    counts : bytes "sent" and "received" by the device; lost as "unplugged", "unheard" (no host has
        the port open) and "overrun" (the host does not read); corrupted as `disturbance.KINDS`
    """

    def __init__(self, seed: int = 0, baud: int = 0) -> None:
        self.counts: Counter[str] = Counter()
        self._wires = _Wire(baud), _Wire(baud)  # inward, outward
        inward, outward = np.random.default_rng(seed).spawn(2)
        self._inward = Disturbance(inward, self.counts)
        self._outward = Disturbance(outward, self.counts)
        self._unplugged_until = 0.0
        self._plugged = True

    @property
    @abstractmethod
    def url(self) -> str:
        """The port that the host opens."""

    @abstractmethod
    def _plug(self) -> None:
        """Make the port available to the host."""

    @abstractmethod
    def _pull(self) -> None:
        """Remove the port, even if it is in use."""

    @abstractmethod
    def _read(self) -> bytes:
        """Return bytes from the host, empty if there are none."""

    @abstractmethod
    def _write(self, data: bytes) -> int | None:
        """Send to the host; return how many bytes it took, None if there is no host."""

    def receive(self, time: float) -> bytes:
        """Return the bytes from the host since the last call; called about every ms."""
        if not self._plugged:
            if time < self._unplugged_until:
                return b""
            self._plug()
            self._plugged = True
        data = self._inward.transfer(self._wires[0].transfer(self._read(), time), time)
        self.counts["received"] += len(data)
        return data

    def send(self, data: bytes, time: float) -> None:
        """Send bytes of the device to the host; call it without data too, for delayed bytes."""
        if not self._plugged:
            self.counts["unplugged"] += len(data)
            return
        data = self._outward.transfer(self._wires[1].transfer(data, time), time)
        if data:
            taken = self._write(data)
            self.counts["sent"] += taken or 0
            self.counts["unheard" if taken is None else "overrun"] += len(data) - (taken or 0)

    def noise(self, rate: float, kind: Kind, until: float) -> None:
        """Corrupt a share of the bytes, in both directions, until a time."""
        self._inward.noise(rate, kind, until)
        self._outward.noise(rate, kind, until)

    def hold(self, until: float) -> None:
        """Hold back all bytes, in both directions, until a time."""
        self._inward.hold(until)
        self._outward.hold(until)

    def unplug(self, until: float) -> None:
        """Remove the port until a time; bytes under way are lost."""
        self._unplugged_until = until
        for part in (*self._wires, self._inward, self._outward):
            part.clear()
        if self._plugged:
            self._plugged = False
            self._pull()

    def close(self) -> None:
        """Remove the port permanently."""
        if self._plugged:
            self._plugged = False
            self._pull()


class _Wire:
    """The delay of a UART: a write arrives with its last byte."""

    def __init__(self, baud: int) -> None:
        self._byte = 10.0 / baud if baud else 0.0  # s, start and stop bit included
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._free = 0.0

    def transfer(self, data: bytes, time: float) -> bytes:
        """Send `data` into the wire at a time, and return what comes out."""
        if not self._byte:
            return data
        if data:
            self._free = max(self._free, time) + len(data) * self._byte
            self._under_way.append((self._free, data))
        out = b""
        while self._under_way and self._under_way[0][0] <= time:
            out += self._under_way.popleft()[1]
        return out

    def clear(self) -> None:
        """Drop the bytes under way."""
        self._under_way.clear()
        self._free = 0.0
