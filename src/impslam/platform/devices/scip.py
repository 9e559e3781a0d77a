"""SCIP 2.0, the protocol of Hokuyo's range finders, as pure functions on bytes.

A request is a command of two letters, its parameters, and a line feed. The response consists of an
echo of the request, a status of two characters, and data in lines of at most 64 characters, each with
a checksum; an empty line ends it (Hokuyo, SCIP 2.0, C-42-03320B, sections 6 to 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from impslam.platform.devices.scip_encoding import (
    DamagedError,
    decode,
    with_checksum,
    without_checksum,
)
from impslam.types import Array, Ints

Mode: TypeAlias = Literal["MD", "MS", "GD", "GS"]

BLOCK = 64  # characters of data a line
STAMP_BITS = 24  # of the sensor's clock, in ms: it wraps every 4 h 39 min 37 s
WIDTH: dict[str, int] = {"MD": 3, "GD": 3, "MS": 2, "GS": 2}  # characters a distance
STREAMS = ("MD", "MS")  # sent sweep by sweep until QT; the others answer once
TEXT_LIMIT = 16  # characters of the user's text in a request
BIT_RATES = (19200, 38400, 57600, 115200, 250000, 500000, 750000)  # of RS-232
ERROR_CODES = 20  # values below this are error codes (URG-04LX, table 3)
MAX_RESPONSE = 32768  # bytes; a response of 9999 steps of 3 characters with checksums is 31 kB


# --------------------------------------------------------------------------- requests


def request(command: str, parameters: str = "", text: str = "") -> bytes:
    """Return a request; the echo repeats `text`, after a semicolon.

    Raises
    ------
    ValueError
        If the text is longer than 16 characters or not printable ASCII.
    """
    if len(text) > TEXT_LIMIT or not (text.isascii() and (not text or text.isprintable())):
        raise ValueError(f"{text!r}: expected at most {TEXT_LIMIT} printable ASCII characters")
    tail = f";{text}" if text else ""
    return f"{command}{parameters}{tail}\n".encode("ascii")


def measure(mode: Mode, first: int, last: int, cluster: int = 1, skip: int = 0) -> bytes:
    """Return a request for the steps `first` to `last`: once (GD, GS) or until QT (MD, MS).

    `cluster` neighbouring steps are merged into one value; `skip` sweeps are left out between two.
    """
    stream = f"{skip:01d}00" if mode in STREAMS else ""
    return request(mode, f"{first:04d}{last:04d}{cluster:02d}{stream}")


# --------------------------------------------------------------------------- responses


class Splitter:
    """Splits a stream of bytes, in pieces of any size, into responses.

    Attributes
    ----------
    dropped : bytes dropped because they were longer than any response
    """

    def __init__(self) -> None:
        self._rest = b""
        self.dropped = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the responses that these bytes complete, without the LF LF at their ends."""
        *whole, self._rest = (self._rest + data).split(b"\n\n")
        if len(self._rest) > MAX_RESPONSE:
            self.dropped += len(self._rest)
            self._rest = b""
        return [stripped for raw in whole if (stripped := raw.lstrip(b"\n"))]


@dataclass(frozen=True, slots=True)
class Response:
    """A response: the request's echo, a status of two characters, and lines of data.

    The switch to SCIP 2.0 is answered as in SCIP 1.1, by a status of one character.
    """

    echo: str
    status: str
    body: tuple[bytes, ...]


def parse(raw: bytes) -> Response:
    """Parse a response of `Splitter`; the lines of its body keep their checksums.

    Raises
    ------
    DamagedError
        If it has no echo, no status, or a wrong checksum on its status.
    """
    lines = raw.split(b"\n")
    if len(lines) < 2 or not raw.isascii():
        raise DamagedError("it lacks an echo or a status")
    echo, status, body = lines[0].decode("ascii"), lines[1], tuple(lines[2:])
    if echo.startswith("SCIP") and len(status) == 1:
        return Response(echo, status.decode("ascii"), body)
    if len(status) != 3:
        raise DamagedError("its status is cut")
    return Response(echo, without_checksum(status).decode("ascii"), body)


def stamp_of(line: bytes) -> int:
    """Return the sensor's clock in ms, 24 bits, from a line of four characters and a checksum.

    Raises
    ------
    DamagedError
        If it is damaged.
    """
    digits = without_checksum(line)
    if len(digits) != 4:
        raise DamagedError("a time stamp does not have four characters")
    return int(decode(digits, 4)[0])


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A raw scan: the sensor's clock at step 0 in ms, and values (n,) in mm or error codes."""

    stamp: int
    values: Ints


def sweep(response: Response, width: int, number: int) -> Sweep:
    """Return the scan of `number` values in a response.

    Raises
    ------
    DamagedError
        If any line is damaged, missing, or superfluous.
    """
    if not response.body:
        raise DamagedError("it carries no scan")
    stamp = stamp_of(response.body[0])
    blocks = response.body[1:]
    full, rest = divmod(number * width, BLOCK)
    expected = [BLOCK + 1] * full + ([rest + 1] if rest else [])
    if [len(block) for block in blocks] != expected:
        raise DamagedError("its lines do not have the lengths of the requested scan")
    return Sweep(stamp, decode(b"".join(map(without_checksum, blocks)), width))


def in_lines(data: bytes) -> bytes:
    """Return characters as lines with checksums; the inverse of `sweep`."""
    return b"".join(with_checksum(data[i : i + BLOCK]) for i in range(0, len(data), BLOCK))


def to_metres(values: Ints, shortest: int, longest: int) -> Array:
    """Return ranges (n,) in m; 0 if the value (mm) is an error code or outside the limits."""
    valid = (values >= max(shortest, ERROR_CODES)) & (values <= longest)
    return np.where(valid, values, 0) * 1e-3
