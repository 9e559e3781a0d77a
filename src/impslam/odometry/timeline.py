"""Increments between messages, cut and composed to increments between scans."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import islice

import numpy as np

from impslam.geometry.se2 import log
from impslam.types import Array, Increment

MOST = 20_000
"""Increments kept apart: 200 s of odometry at 100 Hz without a scan. Then the older half becomes one,
so that a robot whose lidar is silent for hours does not fill its memory."""


class Timeline:
    """The motion not yet handed to the filter, in the order in which it happened.

    Time never runs backwards here: an increment whose stamp lies before the newest one keeps its
    motion and takes no time. So logs whose stamps run backwards are used in file order.
    """

    def __init__(self) -> None:
        self._pending: deque[Increment] = deque()
        self._newest = -np.inf
        self._last_stamp = -np.inf
        self._latest: Increment | None = None
        self._added: tuple[Increment, int, Increment] | None = None

    @property
    def newest(self) -> float:
        """Stamp up to which motion is known."""
        return float(self._newest)

    def start(self, stamp: float) -> None:
        """Say that odometry begins (again) at a stamp, without motion."""
        self._newest = max(self._newest, stamp)
        self._last_stamp = stamp

    def add(self, increment: Increment) -> None:
        """Append the motion that a message told."""
        duration = min(increment.duration, max(increment.stamp - self._newest, 0.0))
        self._last_stamp = increment.stamp
        self._newest = max(self._newest, increment.stamp)
        self._pending.append(
            Increment(self.newest, increment.d_pose, increment.covariance, duration)
        )
        if increment.duration > 0.0:
            self._latest = increment
        if len(self._pending) > MOST:
            self._pending.appendleft(self._oldest(MOST // 2))

    def _oldest(self, count: int) -> Increment:
        """Remove and return the motion of so many increments."""
        total = self._pending.popleft()
        for _ in range(count - 1):
            total = total.then(self._pending.popleft())
        return total

    def covers(self, stamp: float) -> bool:
        """Tell whether motion is known up to a stamp."""
        return self._newest >= stamp

    def ends_at(self, stamp: float) -> bool:
        """Tell whether the newest odometry message carries this very stamp."""
        return stamp == self._last_stamp

    def put_back(self, increment: Increment) -> None:
        """Return motion that was taken and not used."""
        self._pending.appendleft(increment)

    def take(self, stamp: float) -> Increment:
        """Remove and return the motion up to a stamp; an increment across it is cut.

        A scan that carries the stamp of the newest odometry message was recorded with it: all motion
        belongs before it, whatever the other stamps say.
        """
        return _consume(self._pending, stamp, together=self.ends_at(stamp))

    def ahead(self, stamp: float) -> Increment:
        """Return the motion up to a stamp, as far as it is known, and leave it here."""
        return _consume(self._pending.copy(), stamp, together=self.ends_at(stamp))

    def all_ahead(self) -> Increment:
        """Return all motion that is known, and leave it here; each time only what is new is added."""
        if not self._pending:
            return Increment.none(self.newest)
        first, count, total = self._added or (None, 0, Increment.none(self.newest))
        if self._pending[0] is not first:  # some was taken or put back since
            first, count, total = self._pending[0], 0, Increment.none(self.newest)
        new = islice(reversed(self._pending), len(self._pending) - count)
        for increment in reversed(list(new)):
            total = total.then(increment)
        self._added = first, len(self._pending), total
        return total

    def twist(self, stamp: float, duration: float) -> Array:
        """Return the mean body twist (3,) from a stamp on, of what is pending, or the latest one."""
        ahead = Increment.none(stamp)
        for increment in self._pending:
            if increment.stamp - increment.duration > stamp + duration:
                break
            ahead = ahead.then(increment)
        if ahead.duration > 0.0 and ahead.duration >= 0.5 * duration:
            return log(ahead.d_pose) / ahead.duration
        last = self._latest
        return np.zeros(3) if last is None else log(last.d_pose) / last.duration


def _consume(pending: deque[Increment], stamp: float, together: bool) -> Increment:
    """Remove from a queue of increments and return the motion up to a stamp, or all of it."""
    total: Increment | None = None
    while pending:
        first = pending[0]
        begin = first.stamp - first.duration
        if not together and first.stamp > stamp:
            if begin < stamp:
                head, pending[0] = first.split((stamp - begin) / first.duration)
                total = head if total is None else total.then(head)
            break
        first = pending.popleft()
        total = first if total is None else total.then(first)
    return Increment.none(stamp) if total is None else replace(total, stamp=stamp)
