"""A conversation in SCIP 2.0 over a port: one asks, one answers, and between them scans stream."""

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


class UnansweredError(DeviceError):
    """A request that no answer came to."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A response, and when on the host its request was sent and its last byte arrived."""

    response: Response
    arrived: float
    sent: float = float("nan")


class ScipLink:
    """Sends requests and hears responses.

    Parameters
    ----------
    port : open
    stopping : ends all waiting once it is set
    count : told what happens: "damaged responses", "stale responses", "overlong bytes"
    """

    def __init__(
        self,
        port: serial.SerialBase,
        stopping: threading.Event,
        count: Callable[[str, int], None],
    ) -> None:
        self.count = count
        self._port, self._stopping = port, stopping
        self._splitter, self._waiting = Splitter(), deque[Heard]()

    @property
    def where(self) -> str:
        """The port's name, for messages."""
        return str(self._port.port)

    @property
    def bit_rate(self) -> int:
        """Bit rate of the port, in bit/s; without a meaning over USB and TCP."""
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

    def hear(self, wait: float) -> Heard | None:
        """Return the next response that arrived whole; None after `wait` s, or when stopping."""
        end = now() + wait
        while not self._waiting and not self._stopping.is_set():
            left = end - now()
            if left <= 0.0:
                return None
            self._read(min(left, 0.05))
        return self._waiting.popleft() if self._waiting else None

    def ask(self, request: bytes, wait: float = 0.3, tries: int = 3) -> Heard:
        """Send a request and return what answers it; whatever else comes meanwhile is stale.

        Raises
        ------
        UnansweredError
            If none of the tries is answered within `wait`.
        """
        echo = request.decode("ascii").rstrip("\n")
        for _ in range(tries):
            sent = now()
            self.send(request)
            while heard := self.hear(sent + wait - now()):
                if heard.response.echo == echo:
                    return Heard(heard.response, heard.arrived, sent)
                self.count("stale responses", 1)
            if self._stopping.is_set():
                break
        raise UnansweredError(
            f"{self.where}: does not answer {echo[:2]}; check that it is a SCIP 2.0 sensor, "
            "that it has power, and that no other program uses it"
        )

    def hush(self, request: bytes, wait: float = 0.1) -> None:
        """Send a last request, also when stopping, and give it a moment to be answered."""
        self.send(request)
        end = now() + wait
        self._waiting.clear()
        echo = request.decode("ascii").rstrip("\n")
        while now() < end:
            self._read(0.02)
            if any(heard.response.echo == echo for heard in self._waiting):
                return

    def forget(self) -> None:
        """Drop what was heard and not taken."""
        self._waiting.clear()
        self._splitter = Splitter()

    def _read(self, wait: float) -> None:
        data = read_some(self._port, wait)
        arrived = now()
        dropped = self._splitter.dropped
        for raw in self._splitter.feed(data):
            try:
                self._waiting.append(Heard(parse(raw), arrived))
            except DamagedError:
                self.count("damaged responses", 1)
        if self._splitter.dropped > dropped:
            self.count("overlong bytes", self._splitter.dropped - dropped)
