"""SCIP 2.0, the protocol of Hokuyo's range finders, as pure functions on bytes.

A request is a command of two letters, its parameters, and a line feed. The response repeats it,
gives a status of two characters, and data in lines of at most 64 characters, each line closed by a
checksum; an empty line ends it (Hokuyo, SCIP 2.0, C-42-03320B, sections 6 to 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from impslam.platform.devices.scip_encoding import DamagedError, decode, sealed, unsealed
from impslam.types import Array, Ints

Mode: TypeAlias = Literal["MD", "MS", "GD", "GS"]

BLOCK = 64  # characters of data a line
STAMP_BITS = 24  # of the sensor's clock, in ms: it wraps every 4 h 39 min 37 s
WIDTH: dict[str, int] = {"MD": 3, "GD": 3, "MS": 2, "GS": 2}  # characters a distance
STREAMS = ("MD", "MS")  # sent sweep by sweep until QT; the others answer once
TEXT_LIMIT = 16  # characters of the user's own text in a request
ERROR_CODES = 20  # distances below this are no distances (URG-04LX, table 3)
LONGEST = 32768  # bytes; a response of 9999 steps of 3 characters with checksums is 31 kB


# --------------------------------------------------------------------------- requests


def request(command: str, parameters: str = "", text: str = "") -> bytes:
    """Return a request; `text` comes back in the echo, after a semicolon.

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

    `cluster` neighbouring steps are merged into one value; between two sweeps `skip` are left out.
    """
    stream = f"{skip:01d}00" if mode in STREAMS else ""
    return request(mode, f"{first:04d}{last:04d}{cluster:02d}{stream}")


# --------------------------------------------------------------------------- responses


class Splitter:
    """Cuts a stream of bytes, which comes in pieces of any size, into responses.

    Attributes
    ----------
    dropped : bytes given up because they grew beyond what a response can have
    """

    def __init__(self) -> None:
        self._rest = b""
        self.dropped = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the responses that are complete with these bytes, without the LF LF that ends each."""
        *whole, self._rest = (self._rest + data).split(b"\n\n")
        if len(self._rest) > LONGEST:
            self.dropped += len(self._rest)
            self._rest = b""
        return [stripped for raw in whole if (stripped := raw.lstrip(b"\n"))]


@dataclass(frozen=True, slots=True)
class Response:
    """What a sensor answered: the request's echo, a status of two characters, and lines of data.

    The switch to SCIP 2.0 is answered in the way of SCIP 1.1, by a status of one character.
    """

    echo: str
    status: str
    body: tuple[bytes, ...]


def parse(raw: bytes) -> Response:
    """Return a response, cut out by `Splitter`; the lines of its body are still sealed.

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
    return Response(echo, unsealed(status).decode("ascii"), body)


def stamp_of(line: bytes) -> int:
    """Return the sensor's clock in ms, 24 bits, from a sealed line of four characters.

    Raises
    ------
    DamagedError
        If it is damaged.
    """
    said = unsealed(line)
    if len(said) != 4:
        raise DamagedError("a time stamp does not have four characters")
    return int(decode(said, 4)[0])


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One scan as it was sent: the sensor's clock at step 0 in ms, and values (n,) in mm or codes."""

    stamp: int
    values: Ints


def sweep(response: Response, width: int, number: int) -> Sweep:
    """Return the scan of `number` values that a response carries, whole or not at all.

    Raises
    ------
    DamagedError
        If any line of it is damaged, missing, or one too many.
    """
    if not response.body:
        raise DamagedError("it carries no scan")
    stamp = stamp_of(response.body[0])
    blocks = response.body[1:]
    full, rest = divmod(number * width, BLOCK)
    expected = [BLOCK + 1] * full + ([rest + 1] if rest else [])
    if [len(block) for block in blocks] != expected:
        raise DamagedError("its lines do not have the lengths that the scan asked for has")
    return Sweep(stamp, decode(b"".join(map(unsealed, blocks)), width))


def in_lines(data: bytes) -> bytes:
    """Return characters cut into sealed lines; what `sweep` undoes."""
    return b"".join(sealed(data[i : i + BLOCK]) for i in range(0, len(data), BLOCK))


def to_metres(values: Ints, shortest: int, longest: int) -> Array:
    """Return ranges (n,) in m; 0 where the value (mm) is an error code or outside the limits."""
    valid = (values >= max(shortest, ERROR_CODES)) & (values <= longest)
    return np.where(valid, values, 0) * 1e-3
