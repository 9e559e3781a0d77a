"""One time line for streams whose clocks are set while they run.

A computer's clock is set in the middle of a log, by the network or by hand: stamps step back or ahead, of
every stream or of some. What happened still happened in the order of the log. Each stream gets a shift
that is added to its stamps; it changes where the stream's clock was set, so that time goes on by one
period there, and streams that were in step stay in step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impslam.sources.base import Problems

JITTER = 1.0
"""s: stamps that a busy computer gives on arrival run back by up to 0.9 s (the Intel log of the SLAM
benchmarks) and the clock is still the same."""
LEAP = 2.0 * JITTER
"""s: jitter takes stamps ahead by less, from one that is late to one that is early."""


@dataclass(slots=True)
class _Stream:
    """A stream's newest message: its stamp, when that was, how far behind the newest; all in s."""

    shift: float
    stamp: float
    time: float
    lag: float = 0.0
    period: float = 0.0
    leapt: float = 0.0  # how far other streams have leapt ahead since


class _Leap(NamedTuple):
    """The newest leap ahead: whose, at which stamp, and what time it was before; a pause or a step."""

    name: str
    stamp: float
    before: float


class Clocks:
    """Tells what to add to the stamps of each stream to have them on one time line."""

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._streams: dict[str, _Stream] = {}
        self._first, self._now = np.inf, -np.inf
        self._leap = _Leap("", 0.0, 0.0)

    @property
    def elapsed(self) -> float:
        """How long it has been since the first message, s on the one time line."""
        return self._now - self._first if self._streams else 0.0

    def shift(self, name: str, stamp: float) -> float:
        """Return what to add to this stamp of a stream; ask once a message, in the log's order."""
        stream = self._streams.get(name)
        if stream is None:
            now = self._now if self._streams else stamp
            shift = min(self._shifts(), key=lambda s: abs(stamp + s - now))
            stream = self._streams[name] = _Stream(shift, stamp, stamp + shift)
        else:
            self._follow(name, stream, stamp)
        self._advance(name, stream, stamp)
        return stream.shift

    def _follow(self, name: str, stream: _Stream, stamp: float) -> None:
        """Change the stream's shift if its clock, or that of the others, was set since."""
        step, leapt, before = stamp - stream.stamp, stream.leapt, stream.shift
        expected = self._expected(stream)
        low, high = expected - JITTER, max(expected, self._now) + JITTER
        if step >= 0.5 * leapt:  # it went along: a pause of all
            stream.leapt = 0.0
        if abs(step) > JITTER and not low <= stamp + before <= high:
            fitting = [s for s in self._shifts() if low <= stamp + s <= high]
            if fitting:
                stream.shift = min(fitting, key=lambda s: abs(stamp + s - expected))
            elif step < 0.0:
                stream.shift = expected - stamp
            if stream.shift > before:
                self._enter(name, f"back by {stream.period - step:.6g} s", stamp)
        elif leapt and step < 0.5 * leapt and self._leap.before < stamp + before:
            stream.shift += leapt
            stream.leapt = 0.0
            self._enter(self._leap.name, f"ahead by {leapt:.6g} s", self._leap.stamp)
        elif step > 0.0:
            stream.period += (0.1 if stream.period else 1.0) * (step - stream.period)

    def _expected(self, stream: _Stream) -> float:
        """Return when the stream's next message is due, or overdue if others went on without it."""
        due, overdue = stream.time + stream.period, self._now - stream.lag
        return overdue if overdue > due + JITTER else due

    def _shifts(self) -> list[float]:
        """Return the shifts in use; a clock that was set back may be set right again."""
        return [0.0, *(stream.shift for stream in self._streams.values())]

    def _advance(self, name: str, stream: _Stream, stamp: float) -> None:
        """Let time go on to a stamp of a stream."""
        time = stamp + stream.shift
        if time > max(self._now, stream.time + stream.period) + LEAP:
            self._leap = _Leap(name, stamp, self._now)
            leap = time - self._expected(stream)
            for other in self._streams.values():
                other.leapt += 0.0 if other is stream else leap
        self._first, self._now = min(self._first, time), max(self._now, time)
        stream.stamp, stream.time = stamp, max(stream.time, time)
        stream.lag = self._now - time

    def _enter(self, name: str, how: str, stamp: float) -> None:
        self._problems.add(
            "clock step",
            f"the clock stepped {how} at {stamp:.3f} s ({name}); motion is kept in file order",
        )
