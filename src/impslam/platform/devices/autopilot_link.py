"""Commands to the autopilot: from any thread, at once, and those that must arrive until they have."""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impslam.platform.devices.autopilot_messages import Ack, Drive, Kind, Result, SetTime
from impslam.platform.devices.base import DeviceError, now
from impslam.platform.devices.framing import Count, Encoder
from impslam.platform.devices.port import write_all

if TYPE_CHECKING:
    import serial

REPEAT = 0.05  # s between stops (or releases) that have not been answered
SET_TIME_EVERY = 10.0  # s; a crystal drifts by 1 ms at most meanwhile
UNANSWERED = 1.0  # s after which no answer is waited for: a hundred frames have come since
_TRIPS = 1000  # round trips kept: a p99 rests on ten of them, and they span 50 s of driving


class _Sent(NamedTuple):
    """A command under way."""

    kind: Kind
    moment: float
    demand: int


class CommandLink:
    """Sends commands and matches their answers.

    The emergency stop wins: while it is wanted no drive is sent, it is repeated until answered, and
    again whenever the autopilot says that it is not stopped (as after a reboot).

    Parameters
    ----------
    count : called with what happened and how often
    """

    def __init__(self, count: Count) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._port: serial.SerialBase | None = None
        self._encoder: Encoder | None = None
        self._session = os.urandom(1)[0]
        self._failure: DeviceError | None = None
        self._sent: dict[int, _Sent] = {}  # what is not answered yet, oldest first
        self._trips: deque[float] = deque(maxlen=_TRIPS)
        self._stop_wanted = False
        self._pending: Kind | None = None  # STOP or RELEASE until it is answered
        self._demand = 0  # which stop or release, of all that were asked for
        self._repeat_at = self._set_time_at = 0.0

    def attach(self, port: serial.SerialBase) -> None:
        """Begin with a port that has been opened."""
        with self._lock:
            self._session = (self._session + 1) % 256
            self._encoder, self._port, self._failure = Encoder(self._session), port, None
            self._give_up(math.inf)
            self._repeat_at = self._set_time_at = 0.0

    def detach(self) -> None:
        """Write no more to the port; it may be closed then."""
        with self._lock:
            self._port = None

    def drive(self, left: float, right: float) -> None:
        """Send surface speeds in m/s, unless the robot is to be stopped."""
        with self._lock:
            if self._stop_wanted:
                self._count("drive held back", 1)
                return
            self._send(Kind.DRIVE, Drive(round(1e3 * left), round(1e3 * right)).pack())

    def stop(self, wanted: bool) -> None:
        """Send a stop, or the release from it, until it is answered; the last one asked for wins."""
        with self._lock:
            self._stop_wanted = wanted
            self._pending = Kind.STOP if wanted else Kind.RELEASE
            self._demand += 1
            self._send(self._pending)
            self._repeat_at = now() + REPEAT

    @property
    def releasing(self) -> bool:
        """Whether a release has been sent and is not answered yet."""
        return self._pending is Kind.RELEASE

    def greet(self) -> None:
        """Set the autopilot's time as soon as possible; it then says who it is, too."""
        with self._lock:
            self._set_time_at = 0.0

    def tend(self, moment: float) -> None:
        """Send what is due; to be called every 0.05 s at least.

        Raises
        ------
        DeviceError
            If a write has failed, in whatever thread.
        """
        with self._lock:
            if self._pending is not None and moment >= self._repeat_at:
                self._repeat_at = moment + REPEAT
                self._send(self._pending)
            if moment >= self._set_time_at:
                self._set_time_at = moment + SET_TIME_EVERY
                self._send(Kind.SET_TIME, SetTime(int(now() * 1e6)).pack())
            self._give_up(moment)
            if self._failure is not None:
                raise self._failure

    def check_stopped(self, stopped: bool) -> None:
        """Compare what the autopilot says about its stop with what is wanted."""
        with self._lock:
            if self._stop_wanted and not stopped and self._pending is None:
                self._pending = Kind.STOP
                self._count("stop demanded again", 1)

    def answered(self, ack: Ack, arrived: float) -> None:
        """Take an answer."""
        with self._lock:
            sent = self._sent.pop(ack.sequence, None)
            if sent is None or sent.kind != ack.command:
                self._count("answers to nothing", 1)
                return
            if ack.result is not Result.DONE:
                self._count(f"commands refused: {ack.result.name.lower()}", 1)
                return
            self._trips.append(arrived - sent.moment)
            # An answer to an earlier stop says nothing about this one.
            if sent.kind is self._pending and sent.demand == self._demand:
                self._pending = None

    def latency(self) -> tuple[float, float]:
        """Return median and 99th percentile, in s, from command to answer; NaN before the first."""
        with self._lock:
            trips = list(self._trips)
        if not trips:
            return float("nan"), float("nan")
        median, high = np.percentile(trips, [50.0, 99.0])
        return float(median), float(high)

    def _send(self, kind: Kind, payload: bytes = b"") -> None:
        if self._port is None or self._encoder is None:
            self._count("commands not sent", 1)
            return
        sequence, wire = self._encoder.encode(kind, payload)
        sent = now()
        try:
            write_all(self._port, b"\0" + wire)  # the zero ends what noise has left on the line
        except DeviceError as error:
            self._port, self._failure = None, error
            self._count("commands not sent", 1)
            return
        self._sent[sequence] = _Sent(kind, sent, self._demand)
        self._count("commands", 1)

    def _give_up(self, moment: float) -> None:
        while self._sent:
            sequence, sent = next(iter(self._sent.items()))
            if moment - sent.moment < UNANSWERED:
                return
            del self._sent[sequence]
            self._count("commands unanswered", 1)
