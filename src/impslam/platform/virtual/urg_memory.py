"""The state of the emulated URG-04LX: settings, the scan command under way, and the output queue."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from impslam.platform.devices import scip
from impslam.platform.virtual.urg_sensor import LAST_STEP

# The supported commands, and the number of characters of their parameters.
COMMANDS: Final = (
    dict.fromkeys(("BM", "QT", "RS", "VV", "PP", "II"), 0)
    | {"MD": 13, "MS": 13, "GD": 10, "GS": 10}
    | {"TM": 1, "SS": 6, "CR": 2, "HS": 1, "DB": 2}
)


def parameter_error(parameters: str) -> str:
    """Return the error status of the parameters of a scan command; "" if they are valid."""
    parts = {
        "01": parameters[0:4],
        "02": parameters[4:8],
        "03": parameters[8:10],
        "06": parameters[10:11],
        "07": parameters[11:],
    }
    for status, part in parts.items():
        if part and not (part.isascii() and part.isdigit()):
            return status
    if int(parts["02"]) > LAST_STEP:
        return "04"
    return "05" if int(parts["02"]) < int(parts["01"]) else ""


@dataclass(slots=True)
class Order:
    """A scan command under way: MD and MS until their end, GD and GS until the end of a sweep."""

    command: str
    parameters: str
    text: str
    remaining: int = 0
    endless: bool = False
    wait: int = 0  # sweeps to skip

    @property
    def streams(self) -> bool:
        """Whether it continues after a scan."""
        return self.command in scip.STREAMS

    def echo(self) -> str:
        """Return the echo of its responses; for streams, it contains the remaining scans."""
        parameters = self.parameters
        if self.streams:
            parameters = f"{parameters[:-2]}{self.remaining:02d}"
        return f"{self.command}{parameters}{self.text}"


@dataclass(slots=True)
class Memory:
    """The state that a reset clears. Times are in s of the virtual robot."""

    scip2: bool
    bit_rate: int
    ready: float = 0.0  # input before this time is ignored
    adjusting: bool = False
    sensitive: bool = False
    order: Order | None = None
    failure: str = ""  # the status of a malfunction
    verified: float = math.inf  # end of the verification of a failure


@dataclass(slots=True)
class OutputLine:
    """The output line: RS-232 delays bytes, USB (`bit_rate` 0) does not."""

    queue: deque[tuple[float, bytes]] = field(default_factory=deque)
    free: float = -math.inf  # when the last byte has arrived

    def send(self, data: bytes, ready: float, bit_rate: int) -> None:
        """Queue data that is ready at a time; it arrives with its last byte."""
        self.free = max(ready, self.free) + (10.0 * len(data) / bit_rate if bit_rate else 0.0)
        self.queue.append((self.free, data))

    def due(self, time: float) -> bytes:
        """Return the data that has arrived."""
        out = []
        while self.queue and self.queue[0][0] <= time:
            out.append(self.queue.popleft()[1])
        return b"".join(out)
