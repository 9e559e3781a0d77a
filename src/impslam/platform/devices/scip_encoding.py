"""The encoding of SCIP 2.0: numbers as characters of 6 bits, and lines with a checksum.

Values are split into digits of 6 bits, most significant first, each sent as the character 0x30 + digit
(Hokuyo, SCIP 2.0, C-42-03320B, section 6). A line ends with the low 6 bits of the sum of its bytes.
"""

from __future__ import annotations

import numpy as np

from impslam.errors import ImpError
from impslam.types import Ints


class DamagedError(ImpError):
    """A damaged response; it is counted and dropped."""


def checksum(data: bytes) -> int:
    """Return the checksum of a line: 0x30 + the low 6 bits of the sum of its bytes."""
    return (sum(data) & 0x3F) + 0x30


def with_checksum(line: bytes) -> bytes:
    """Return a line with its checksum and line feed, as it is sent."""
    return b"%b%c\n" % (line, checksum(line))


def without_checksum(line: bytes) -> bytes:
    """Return a line without its checksum.

    Raises
    ------
    DamagedError
        If the checksum is wrong.
    """
    if len(line) < 2 or checksum(line[:-1]) != line[-1]:
        raise DamagedError("a line has a wrong checksum")
    return line[:-1]


def encode(values: Ints, width: int) -> bytes:
    """Return values (n,) as `width` characters each; the inverse of `decode`."""
    digits = (values[:, None] >> _shifts(width)) & 0x3F
    return (digits + 0x30).astype(np.uint8).tobytes()


def decode(data: bytes, width: int) -> Ints:
    """Return the values (n,) of characters, `width` each, most significant digit first.

    Raises
    ------
    DamagedError
        If a character is invalid, or some are left over.
    """
    if len(data) % width:
        raise DamagedError(f"{len(data)} characters are no whole number of values")
    digits = np.frombuffer(data, np.uint8) - np.uint8(0x30)  # below 0x30 wraps to large
    if (digits > 0x3F).any():
        raise DamagedError("a character lies outside 0x30 to 0x6F")
    shifted = digits.reshape(-1, width).astype(np.int64) << _shifts(width)
    return np.asarray(shifted.sum(1), dtype=np.int64)


def _shifts(width: int) -> Ints:
    return 6 * np.arange(width - 1, -1, -1, dtype=np.int64)
