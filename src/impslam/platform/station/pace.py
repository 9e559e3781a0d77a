"""The pace of a replay: when the next scan is due, and who may hold it."""

from __future__ import annotations

import math
import threading
import time
from typing import Literal, TypeAlias

from impslam.errors import ImpError

Verdict: TypeAlias = Literal["go", "halted", "stopped"]

SLOWEST, FASTEST = 0.1, 100.0
GAP = 2.0
"""s between two scans beyond which the time between them is skipped: nobody wants to wait for a
robot that was switched off, and no lidar is that slow."""
LAG = 0.1
"""s that a replay may be late and catch up; what is more is forgotten, since the computer cannot."""


class Pace:
    """Turns the stamps of a log into moments, at a speed that may change, with halts and steps.

    One thread calls `wait` and `stepped`, any thread the rest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._paused, self._told, self._owed, self._stopped = False, False, 0, False
        self._rushing = False
        self._speed = 1.0
        # Played time counts the log's seconds without gaps: it was `_at` at the moment `_since`.
        self._at, self._since = 0.0, time.monotonic()
        self._seconds, self._stamp = 0.0, math.nan  # of the newest scan let through
        self._skipped, self._note = 0.0, ""

    @property
    def paused(self) -> bool:
        """Tell whether it is halted, or will be before the next scan."""
        return self._paused

    @property
    def speed(self) -> float:
        """S of log in a second, inf: as fast as possible."""
        return self._speed

    @property
    def place(self) -> tuple[float, float, float, str]:
        """Newest stamp, seconds played, seconds skipped, and what was skipped last, in words."""
        return self._stamp, self._seconds, self._skipped, self._note

    def pause(self) -> None:
        """Halt before the next scan."""
        with self._changed:
            self._paused, self._owed = True, 0
            self._changed.notify()

    def resume(self) -> None:
        """Go on."""
        with self._changed:
            self._paused, self._owed = False, 0
            self._anchor()
            self._changed.notify()

    def step(self) -> None:
        """Let one scan through, and halt."""
        with self._changed:
            self._paused = True
            self._owed += 1
            self._changed.notify()

    def rush(self, on: bool) -> None:
        """Let all through at once, whatever pause and speed say, until it is off."""
        with self._changed:
            self._rushing = on
            self._anchor()
            self._changed.notify()

    def stop(self) -> None:
        """Let nothing through any more."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def set_speed(self, speed: float) -> None:
        """Go on at a speed; raise ImpError if it is none."""
        if not (SLOWEST <= speed <= FASTEST or speed == math.inf):
            raise ImpError(f"a speed of {speed:g} is none; give {SLOWEST:g} to {FASTEST:g}, or inf")
        with self._changed:
            self._anchor()
            self._speed = speed
            self._changed.notify()

    def stepped(self, scans: int) -> None:
        """Tell that scans have been played: what is asked for by `step` is what is seen."""
        with self._changed:
            self._owed = max(self._owed - scans, 0)

    def wait(self, stamp: float) -> Verdict:
        """Wait until the scan of a stamp is due: "go"; "halted" once at each halt, to wait again."""
        with self._changed:
            target = self._seconds + self._ahead(stamp)
            while not self._stopped:
                left = self._left(target)
                if left <= 0.0:
                    self._let_through(stamp, target)
                    return "go"
                if left == math.inf and not self._told:
                    self._told = True
                    return "halted"
                self._changed.wait(None if left == math.inf else left)
            return "stopped"

    def _left(self, target: float) -> float:
        """Return the seconds until a played time, inf at a halt."""
        if self._rushing:
            return 0.0
        if self._paused:
            return 0.0 if self._owed else math.inf
        if self._speed == math.inf:
            return 0.0
        return (target - self._at) / self._speed - (time.monotonic() - self._since)

    def _let_through(self, stamp: float, target: float) -> None:
        late = -self._left(target)
        backward, forward = self._jump(stamp)
        if forward:
            self._skipped += forward
            self._note = f"skipped {forward:.1f} s without scans before {stamp:.3f} s"
        if backward:
            self._note = f"stamps jump back by {backward:.1f} s to {stamp:.3f} s; played on"
        newest = math.isnan(self._stamp) or backward or stamp > self._stamp
        self._stamp = stamp if newest else self._stamp
        self._seconds, self._told = target, False
        if late > LAG or self._paused or self._speed == math.inf:
            self._anchor()

    def _anchor(self) -> None:
        """Count from the newest scan on."""
        self._at, self._since = self._seconds, time.monotonic()

    def _ahead(self, stamp: float) -> float:
        """Return the seconds from the newest scan to this one; none across a gap or backwards."""
        ahead = stamp - self._stamp
        return ahead if 0.0 < ahead <= GAP else 0.0

    def _jump(self, stamp: float) -> tuple[float, float]:
        """Return how far the stamps jump back and ahead, 0 where they do not."""
        ahead = stamp - self._stamp
        return max(-ahead, 0.0) if ahead < -GAP else 0.0, ahead if ahead > GAP else 0.0
