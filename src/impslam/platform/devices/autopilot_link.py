"""Commands to the autopilot, from any thread; stops and releases are repeated until answered."""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impslam.platform.devices.autopilot_messages import (
    Ack,
    DriveCommand,
    FrameType,
    Result,
    SetTime,
)
from impslam.platform.devices.base import DeviceError, now
from impslam.platform.devices.framing import Count, Encoder
from impslam.platform.devices.port import write_all

if TYPE_CHECKING:
    import serial

REPEAT_INTERVAL = 0.05  # s between repetitions of an unanswered stop or release
SET_TIME_INTERVAL = 10.0  # s, in which a crystal drifts by 1 ms at most
ACK_TIMEOUT = 1.0  # s until a command counts as unanswered: a hundred frames
_MAX_TRIPS = 1000  # round trips kept, 50 s of driving: ten of them are above the p99


class _Sent(NamedTuple):
    """A command that is not answered yet."""

    kind: FrameType
    moment: float
    request_number: int


class CommandLink:
    """Sends commands and matches their answers.

    The emergency stop has priority: while it is wanted, no drive command is sent, and it is repeated
    until answered, and again if the autopilot reports that it is not stopped (as after a reboot).

    Parameters
    ----------
    count : called with a counter and an increment
    """

    def __init__(self, count: Count) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._port: serial.SerialBase | None = None
        self._encoder: Encoder | None = None
        self._session = os.urandom(1)[0]
        self._failure: DeviceError | None = None
        self._sent: dict[int, _Sent] = {}  # commands not answered yet, oldest first
        self._trips: deque[float] = deque(maxlen=_MAX_TRIPS)
        self._stop_wanted = False
        self._pending: FrameType | None = None  # STOP or RELEASE until it is answered
        self._request_number = 0  # of the latest stop or release
        self._repeat_at = self._set_time_at = 0.0

    def attach(self, port: serial.SerialBase) -> None:
        """Begin a session with an open port."""
        with self._lock:
            self._session = (self._session + 1) % 256
            self._encoder, self._port, self._failure = Encoder(self._session), port, None
            self._expire(math.inf)
            self._repeat_at = self._set_time_at = 0.0

    def detach(self) -> None:
        """Write no more to the port, so that it can be closed."""
        with self._lock:
            self._port = None

    def drive(self, left: float, right: float) -> None:
        """Send surface speeds in m/s, unless an emergency stop is wanted."""
        with self._lock:
            if self._stop_wanted:
                self._count("drive held back", 1)
                return
            self._send(FrameType.DRIVE, DriveCommand(round(1e3 * left), round(1e3 * right)).pack())

    def stop(self, wanted: bool) -> None:
        """Send a stop or a release, repeated until answered; it replaces an earlier one."""
        with self._lock:
            self._stop_wanted = wanted
            self._pending = FrameType.STOP if wanted else FrameType.RELEASE
            self._request_number += 1
            self._send(self._pending)
            self._repeat_at = now() + REPEAT_INTERVAL

    @property
    def releasing(self) -> bool:
        """Whether a release has been sent and is not answered yet."""
        return self._pending is FrameType.RELEASE

    def request_hello(self) -> None:
        """Set the autopilot's time as soon as possible, which it answers with HELLO."""
        with self._lock:
            self._set_time_at = 0.0

    def update(self, moment: float) -> None:
        """Send due repetitions and the time; must be called at least every 0.05 s.

        Raises
        ------
        DeviceError
            If a write has failed in any thread.
        """
        with self._lock:
            if self._pending is not None and moment >= self._repeat_at:
                self._repeat_at = moment + REPEAT_INTERVAL
                self._send(self._pending)
            if moment >= self._set_time_at:
                self._set_time_at = moment + SET_TIME_INTERVAL
                self._send(FrameType.SET_TIME, SetTime(int(now() * 1e6)).pack())
            self._expire(moment)
            if self._failure is not None:
                raise self._failure

    def check_stopped(self, stopped: bool) -> None:
        """Send a wanted stop again if the autopilot reports that it is not stopped."""
        with self._lock:
            if self._stop_wanted and not stopped and self._pending is None:
                self._pending = FrameType.STOP
                self._count("stop demanded again", 1)

    def on_ack(self, ack: Ack, arrived: float) -> None:
        """Process an answer."""
        with self._lock:
            sent = self._sent.pop(ack.sequence, None)
            if sent is None or sent.kind != ack.command:
                self._count("answers to nothing", 1)
                return
            if ack.result is not Result.DONE:
                self._count(f"commands refused: {ack.result.name.lower()}", 1)
                return
            self._trips.append(arrived - sent.moment)
            # An answer to an earlier stop does not confirm this one.
            if sent.kind is self._pending and sent.request_number == self._request_number:
                self._pending = None

    def latency(self) -> tuple[float, float]:
        """Return median and 99th percentile of the time from command to answer, s; NaN before one."""
        with self._lock:
            trips = list(self._trips)
        if not trips:
            return float("nan"), float("nan")
        median, high = np.percentile(trips, [50.0, 99.0])
        return float(median), float(high)

    def _send(self, kind: FrameType, payload: bytes = b"") -> None:
        if self._port is None or self._encoder is None:
            self._count("commands not sent", 1)
            return
        sequence, wire = self._encoder.encode(kind, payload)
        sent = now()
        try:
            write_all(self._port, b"\0" + wire)  # the zero ends remains of noise on the line
        except DeviceError as error:
            self._port, self._failure = None, error
            self._count("commands not sent", 1)
            return
        self._sent[sequence] = _Sent(kind, sent, self._request_number)
        self._count("commands", 1)

    def _expire(self, moment: float) -> None:
        while self._sent:
            sequence, sent = next(iter(self._sent.items()))
            if moment - sent.moment < ACK_TIMEOUT:
                return
            del self._sent[sequence]
            self._count("commands unanswered", 1)
