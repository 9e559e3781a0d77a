"""A SCIP 2.0 connection over a port: requests, their answers, and streamed scans in between."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from impslam.platform.devices.base import DeviceError, now
from impslam.platform.devices.port import read_some, write_all
from impslam.platform.devices.scip import Response, Splitter, parse
from impslam.platform.devices.scip_encoding import DamagedError

if TYPE_CHECKING:
    import serial

LAST_WAIT = 0.1  # s for the answer to a last request


class UnansweredError(DeviceError):
    """A request without an answer."""


@dataclass(frozen=True, slots=True)
class ReceivedResponse:
    """A response, and the host times of its request and its last byte."""

    response: Response
    arrived: float
    sent: float = float("nan")


class ScipLink:
    """Sends requests and receives responses.

    Parameters
    ----------
    port : an open port
    stopping : ends all waiting once it is set
    count : increases counters: "damaged responses", "stale responses", "overlong bytes"
    """

    def __init__(
        self,
        port: serial.SerialBase,
        stopping: threading.Event,
        count: Callable[[str, int], None],
    ) -> None:
        self.count = count
        self._port, self._stopping = port, stopping
        self._splitter, self._received = Splitter(), deque[ReceivedResponse]()

    @property
    def where(self) -> str:
        """The port's name, for messages."""
        return str(self._port.port)

    @property
    def bit_rate(self) -> int:
        """Bit rate of the port, bit/s; has no effect over USB and TCP."""
        return int(self._port.baudrate)

    @bit_rate.setter
    def bit_rate(self, rate: int) -> None:
        if rate == self._port.baudrate:
            return
        try:
            self._port.baudrate = rate
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"{self.where}: cannot run at {rate} bit/s: {error}; choose another baud"
            ) from error

    def send(self, request: bytes) -> None:
        """Send a request."""
        write_all(self._port, request)

    def receive(self, wait: float) -> ReceivedResponse | None:
        """Return the next undamaged response; None after `wait` s, or when stopping."""
        end = now() + wait
        while not self._received and not self._stopping.is_set():
            left = end - now()
            if left <= 0.0:
                return None
            self._read(min(left, 0.05))
        return self._received.popleft() if self._received else None

    def query(self, request: bytes, wait: float = 0.3, tries: int = 3) -> ReceivedResponse:
        """Send a request and return its answer; other responses meanwhile are stale.

        Raises
        ------
        UnansweredError
            If none of the tries is answered within `wait`.
        """
        echo = request.decode("ascii").rstrip("\n")
        for _ in range(tries):
            sent = now()
            self.send(request)
            while received := self.receive(sent + wait - now()):
                if received.response.echo == echo:
                    return ReceivedResponse(received.response, received.arrived, sent)
                self.count("stale responses", 1)
            if self._stopping.is_set():
                break
        raise UnansweredError(
            f"{self.where}: does not answer {echo[:2]}; check that it is a SCIP 2.0 sensor, "
            "that it has power, and that no other program uses it"
        )

    def send_last(self, request: bytes) -> None:
        """Send a last request, even when stopping, and wait shortly for its answer."""
        self.send(request)
        end = now() + LAST_WAIT
        self._received.clear()
        echo = request.decode("ascii").rstrip("\n")
        while now() < end:
            self._read(0.02)
            if any(received.response.echo == echo for received in self._received):
                return

    def discard(self) -> None:
        """Discard pending responses and bytes."""
        self._received.clear()
        self._splitter = Splitter()

    def _read(self, wait: float) -> None:
        data = read_some(self._port, wait)
        arrived = now()
        dropped = self._splitter.dropped
        for raw in self._splitter.feed(data):
            try:
                self._received.append(ReceivedResponse(parse(raw), arrived))
            except DamagedError:
                self.count("damaged responses", 1)
        if self._splitter.dropped > dropped:
            self.count("overlong bytes", self._splitter.dropped - dropped)
