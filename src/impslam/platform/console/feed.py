"""What all open pages share: each thing is made once, however many look at it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from impslam.observers.live_view import Snapshot
from impslam.platform.console.encoding import Frame, Known, Mark, common, difference, mark
from impslam.platform.console.model import Model
from impslam.platform.devices.base import now
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.shelf import Binned
from impslam.platform.station.station import StationHealth
from impslam.platform.station.store import StoredLog
from impslam.types import Array

T = TypeVar("T")

KEPT = 1000  # latencies: a minute and a half of scans, enough for a 99th percentile
SENT = 64  # snapshots whose arrival is remembered until the pages tell that they are drawn


class Cached(Generic[T]):
    """A value that is asked for by many and made anew at most every `period` s."""

    def __init__(self, make: Callable[[], T], period: float) -> None:
        self._make, self._period = make, period
        self._lock = threading.Lock()
        self._value: T
        self._made, self._expired = float("-inf"), False

    def __call__(self) -> T:
        """Return the value."""
        with self._lock:
            if self._expired or time.monotonic() - self._made >= self._period:
                self._expired = False
                self._value, self._made = self._make(), time.monotonic()
            return self._value

    def expire(self) -> None:
        """Have it made anew when it is asked for next; never waits for who makes it now."""
        self._expired = True


class Feed:
    """Frames of a model's map for any number of pages, and how late they were drawn.

    Attributes
    ----------
    health : how a robot is doing; call it
    logs, maps : those on its disk, and their recycle bin; call it, in a thread, since it looks there
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.health = Cached(self._health, 0.5)
        self.logs = Cached(self._logs, 1.5)
        self.maps = Cached(self._maps, 1.5)
        self._common: Frame = {"seq": -1}
        self._marks: dict[int, Mark] = {}
        self._landmarks: Any = None
        self._arrived: dict[int, float] = {}
        self._latencies: deque[float] = deque(maxlen=KEPT)

    def frame(self, known: Known) -> Frame | None:
        """Return what is news to a page, None if nothing is; call it from the event loop only."""
        snapshot = self.model.view.snapshot()
        if snapshot.version == known.version:
            return None
        if snapshot.version != self._common["seq"]:
            self._encode(snapshot)
        return self._common | difference(snapshot, self._marks, known)

    def drawn(self, version: int) -> None:
        """Note that a page has drawn a snapshot; a number that was never sent is ignored."""
        arrived = self._arrived.get(version)
        if arrived is not None:
            self._latencies.append(now() - arrived)

    def latencies(self) -> Array:
        """Return (n,) s from a scan's arrival to its being drawn and acknowledged, oldest first."""
        return np.array(self._latencies)

    def _health(self) -> StationHealth:
        assert self.model.station is not None
        return self.model.station.health()

    def _logs(self) -> tuple[list[StoredLog], list[Binned]]:
        assert self.model.station is not None
        store = self.model.station.store
        return store.logs(), store.bin()

    def _maps(self) -> tuple[list[StoredMap], list[Binned]]:
        assert self.model.station is not None
        store = self.model.station.maps
        return store.maps(), store.bin()

    def _encode(self, snapshot: Snapshot) -> None:
        self._common = common(snapshot)
        if snapshot.landmarks is not self._landmarks:
            self._landmarks = snapshot.landmarks
            self._marks = {one.id: mark(one) for one in snapshot.landmarks}
        # A replay's scans arrived when the log was made; a map without a scan yet says NaN.
        if self.model.station is not None and np.isfinite(snapshot.arrived):
            self._arrived[snapshot.version] = snapshot.arrived
            while len(self._arrived) > SENT:
                del self._arrived[next(iter(self._arrived))]
