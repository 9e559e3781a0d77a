"""Lines between an emulator and the host, with a plug and with faults.

Nothing here waits: what the host does not take is lost and counted, as on a UART that nobody reads.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque

import numpy as np

from impslam.platform.virtual.disturbance import Disturbance, Kind

CHUNK = 65536  # bytes read at once


class Line(ABC):
    """A line with a plug and with faults. All times are in s since the virtual robot began.

    Parameters
    ----------
    seed : of the noise on it
    baud : bit/s at which it passes bytes, ten bits each; 0: at once, as USB and TCP do nearly

    Attributes
    ----------
    counts : bytes "sent" and "received" by the device's end; lost as "unplugged", "unheard" (no
        host has the port open) and "overrun" (the host does not read); spoilt as `disturbance.KINDS`
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
        """What the host opens."""

    @abstractmethod
    def _plug(self) -> None:
        """Make the port available to the host."""

    @abstractmethod
    def _pull(self) -> None:
        """Take the port away, whoever uses it."""

    @abstractmethod
    def _read(self) -> bytes:
        """Return what the host has sent, empty if nothing."""

    @abstractmethod
    def _write(self, data: bytes) -> int | None:
        """Send to the host; return how much it takes, None if there is no host."""

    def receive(self, time: float) -> bytes:
        """Return what came from the host since the last call; called about every ms."""
        if not self._plugged:
            if time < self._unplugged_until:
                return b""
            self._plug()
            self._plugged = True
        data = self._inward.passed(self._wires[0].passed(self._read(), time), time)
        self.counts["received"] += len(data)
        return data

    def send(self, data: bytes, time: float) -> None:
        """Send to the host what the device says; call it without data too: delayed bytes end."""
        if not self._plugged:
            self.counts["unplugged"] += len(data)
            return
        data = self._outward.passed(self._wires[1].passed(data, time), time)
        if data:
            taken = self._write(data)
            self.counts["sent"] += taken or 0
            self.counts["unheard" if taken is None else "overrun"] += len(data) - (taken or 0)

    def noise(self, rate: float, kind: Kind, until: float) -> None:
        """Spoil a share of the bytes, in both directions, until a time."""
        self._inward.noise(rate, kind, until)
        self._outward.noise(rate, kind, until)

    def hold(self, until: float) -> None:
        """Hold all bytes back, in both directions, until a time."""
        self._inward.hold(until)
        self._outward.hold(until)

    def unplug(self, until: float) -> None:
        """Take the port away until a time; what is under way is lost."""
        self._unplugged_until = until
        for part in (*self._wires, self._inward, self._outward):
            part.forget()
        if self._plugged:
            self._plugged = False
            self._pull()

    def close(self) -> None:
        """Take the port away for good."""
        if self._plugged:
            self._plugged = False
            self._pull()


class _Wire:
    """Bytes on their way over a UART: a write arrives when its last byte has."""

    def __init__(self, baud: int) -> None:
        self._byte = 10.0 / baud if baud else 0.0  # s, start and stop bit included
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._free = 0.0

    def passed(self, data: bytes, time: float) -> bytes:
        """Return what comes out at a time when `data` goes in."""
        if not self._byte:
            return data
        if data:
            self._free = max(self._free, time) + len(data) * self._byte
            self._under_way.append((self._free, data))
        out = b""
        while self._under_way and self._under_way[0][0] <= time:
            out += self._under_way.popleft()[1]
        return out

    def forget(self) -> None:
        """Lose what is under way."""
        self._under_way.clear()
        self._free = 0.0
