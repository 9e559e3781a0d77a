"""The pace of a replay: when the next scan is due, with speed, pause and step."""

from __future__ import annotations

import math
import threading
import time
from typing import Literal, TypeAlias

from impslam.errors import ImpError

Verdict: TypeAlias = Literal["go", "halted", "stopped"]

MIN_SPEED, MAX_SPEED = 0.1, 100.0
MAX_SCAN_GAP = 2.0
"""s between two scans; a longer gap is skipped: no lidar is that slow, so the robot was switched off."""
MAX_LAG = 0.1
"""s of delay that a replay catches up with; a longer delay is kept, since the computer is too slow."""


class Pace:
    """Schedules the scans of a log by their stamps, with a variable speed, pause and step.

    One thread calls `wait` and `played`; any thread may call the rest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._paused, self._halt_reported, self._steps_due, self._stopped = False, False, 0, False
        self._unpaced = False
        self._speed = 1.0
        # Played time is log time without gaps: it was `_at` at the monotonic time `_since`.
        self._at, self._since = 0.0, time.monotonic()
        self._seconds, self._stamp = 0.0, math.nan  # of the newest scan let through
        self._skipped, self._note = 0.0, ""

    @property
    def paused(self) -> bool:
        """Whether it is paused, or will be before the next scan; not while all scans are let through."""
        return self._paused and not self._unpaced

    @property
    def speed(self) -> float:
        """Seconds of log per second; inf is as fast as possible."""
        return self._speed

    @property
    def place(self) -> tuple[float, float, float, str]:
        """Newest stamp, seconds played, seconds skipped, and a note about the last skip."""
        return self._stamp, self._seconds, self._skipped, self._note

    def pause(self) -> None:
        """Halt before the next scan."""
        with self._changed:
            self._paused, self._steps_due = True, 0
            self._changed.notify()

    def resume(self) -> None:
        """Resume."""
        with self._changed:
            self._paused, self._steps_due = False, 0
            self._anchor()
            self._changed.notify()

    def step(self) -> None:
        """Let one scan through, then pause."""
        with self._changed:
            self._paused = True
            self._steps_due += 1
            self._changed.notify()

    def set_unpaced(self, on: bool) -> None:
        """Let all scans through at once, regardless of pause and speed, or end that."""
        with self._changed:
            self._unpaced = on
            self._anchor()
            self._changed.notify()

    def stop(self) -> None:
        """Let no more scans through."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def set_speed(self, speed: float) -> None:
        """Change the speed; raise ImpError if it is out of range."""
        if not (MIN_SPEED <= speed <= MAX_SPEED or speed == math.inf):
            raise ImpError(
                f"a speed of {speed:g} is invalid; give {MIN_SPEED:g} to {MAX_SPEED:g}, or inf"
            )
        with self._changed:
            self._anchor()
            self._speed = speed
            self._changed.notify()

    def played(self, scans: int) -> None:
        """Count played scans towards the requested steps."""
        with self._changed:
            self._steps_due = max(self._steps_due - scans, 0)

    def wait(self, stamp: float) -> Verdict:
        """Wait until the scan of a stamp is due.

        Return "go" when it is due, "stopped" after `stop`, and "halted" once per pause; then wait again.
        """
        with self._changed:
            target = self._seconds + self._ahead(stamp)
            while not self._stopped:
                left = self._left(target)
                if left <= 0.0:
                    self._let_through(stamp, target)
                    return "go"
                if left == math.inf and not self._halt_reported:
                    self._halt_reported = True
                    return "halted"
                self._changed.wait(None if left == math.inf else left)
            return "stopped"

    def _left(self, target: float) -> float:
        """Return the seconds until a played time, inf while paused."""
        if self._unpaced:
            return 0.0
        if self._paused:
            return 0.0 if self._steps_due else math.inf
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
        self._seconds, self._halt_reported = target, False
        if late > MAX_LAG or self._paused or self._speed == math.inf:
            self._anchor()

    def _anchor(self) -> None:
        """Restart the clock at the newest scan."""
        self._at, self._since = self._seconds, time.monotonic()

    def _ahead(self, stamp: float) -> float:
        """Return the seconds from the newest scan to this one; 0 across a gap or backwards."""
        ahead = stamp - self._stamp
        return ahead if 0.0 < ahead <= MAX_SCAN_GAP else 0.0

    def _jump(self, stamp: float) -> tuple[float, float]:
        """Return the jump of the stamps back and ahead, s, 0 if there is none."""
        ahead = stamp - self._stamp
        back = -ahead if ahead < -MAX_SCAN_GAP else 0.0
        return back, ahead if ahead > MAX_SCAN_GAP else 0.0
