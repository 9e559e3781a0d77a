"""The data that all open pages share, so that it is made only once."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from impslam.observers.live_view import Snapshot
from impslam.platform.console.encoding import Frame, Mark, SentState, common, difference, mark
from impslam.platform.console.model import Model
from impslam.platform.devices.base import now
from impslam.platform.station.log_store import StoredLog
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.station import StationHealth
from impslam.platform.station.store import DeletedEntry
from impslam.types import Array

T = TypeVar("T")

MAX_LATENCIES = 1000  # latencies: a minute and a half of scans, enough for a 99th percentile
MAX_PENDING = 64  # snapshots that wait for pages to report that they are drawn


class Cached(Generic[T]):
    """A value that is recomputed at most every `period` s."""

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
        """Recompute the value at the next call; never blocks."""
        self._expired = True


class Feed:
    """Frames of a model's map for any number of pages, and the latencies of drawing.

    Attributes
    ----------
    health : returns the status of the robot
    logs, maps : return those on its disk, and their recycle bin; call in a thread, as the disk is read
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
        self._latencies: deque[float] = deque(maxlen=MAX_LATENCIES)

    def frame(self, sent: SentState) -> Frame | None:
        """Return what has changed for a page, None if nothing; call it only in the event loop."""
        snapshot = self.model.view.snapshot()
        if snapshot.version == sent.version:
            return None
        if snapshot.version != self._common["seq"]:
            self._encode(snapshot)
        return self._common | difference(snapshot, self._marks, sent)

    def drawn(self, version: int) -> None:
        """Record that a page has drawn a snapshot; ignore versions that were never sent."""
        arrived = self._arrived.get(version)
        if arrived is not None:
            self._latencies.append(now() - arrived)

    def latencies(self) -> Array:
        """Return (n,) s from the arrival of a scan to the report that it is drawn, oldest first."""
        return np.array(self._latencies)

    def _health(self) -> StationHealth:
        assert self.model.station is not None
        return self.model.station.health()

    def _logs(self) -> tuple[list[StoredLog], list[DeletedEntry]]:
        assert self.model.station is not None
        store = self.model.station.store
        return store.logs(), store.bin()

    def _maps(self) -> tuple[list[StoredMap], list[DeletedEntry]]:
        assert self.model.station is not None
        store = self.model.station.maps
        return store.maps(), store.bin()

    def _encode(self, snapshot: Snapshot) -> None:
        self._common = common(snapshot)
        if snapshot.landmarks is not self._landmarks:
            self._landmarks = snapshot.landmarks
            self._marks = {one.id: mark(one) for one in snapshot.landmarks}
        # Scans of a replay arrived when the log was made; before the first scan, it is NaN.
        if self.model.station is not None and np.isfinite(snapshot.arrived):
            self._arrived[snapshot.version] = snapshot.arrived
            while len(self._arrived) > MAX_PENDING:
                del self._arrived[next(iter(self._arrived))]
