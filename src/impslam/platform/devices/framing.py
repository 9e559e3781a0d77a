"""Frames on the autopilot's line: COBS, CRC-16 and sequence numbers (docs/autopilot-protocol.md).

    COBS(version u8, type u8, boot u8, sequence u16, payload, crc u16), 0x00        little endian

The CRC is CRC-16/XMODEM (polynomial 0x1021, from 0) over all before it. COBS (Cheshire and Baker,
IEEE/ACM ToN 1999) leaves no zero in a frame, so that the next zero always ends it. `boot` distinguishes
a sender that has restarted, with its sequence, from one whose frames got lost.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass

from impslam.platform.devices.port import extra

VERSION = 1
_HEADER = struct.Struct("<BBBH")
_CRC = struct.Struct("<H")
_MIN_SIZE = _HEADER.size + _CRC.size
MAX_PAYLOAD = 254 - _MIN_SIZE  # COBS then adds one byte
_MAX_WIRE_SIZE = 255  # bytes of a frame on the wire, without its zero
_HALF = 1 << 15
RESTART_FRAMES = 3  # consecutive late frames that indicate a restart of the sender

Count = Callable[[str, int], object]


@dataclass(frozen=True, slots=True)
class Frame:
    """A valid frame, received in order."""

    type: int
    boot: int
    sequence: int
    payload: bytes


class Encoder:
    """Encodes frames with increasing sequence numbers.

    Parameters
    ----------
    boot : number of starts of the sender, modulo 256
    """

    def __init__(self, boot: int = 0) -> None:
        self._encode = extra("cobs.cobs").encode
        self._boot, self._next = boot % 256, 0

    def encode(self, kind: int, payload: bytes = b"") -> tuple[int, bytes]:
        """Return the sequence number of a new frame and its bytes, with the zero at its end."""
        if len(payload) > MAX_PAYLOAD:
            raise ValueError(f"a payload of {len(payload)} bytes; {MAX_PAYLOAD} fit into a frame")
        sequence, self._next = self._next, (self._next + 1) % 65536
        body = _HEADER.pack(VERSION, kind, self._boot, sequence) + payload
        body += _CRC.pack(binascii.crc_hqx(body, 0))
        return sequence, self._encode(body) + b"\0"


class Decoder:
    """Decodes frames from pieces of a byte stream, and counts errors.

    Counters: "frames" (returned); "corrupt" (CRC, COBS, or length); "fragment" (before the first zero
    after `restart`); "lost" (gaps of the sequence); "repeated" and "late" (sequence as before, or
    behind: dropped); "unknown version" and "unknown type" (dropped); "restarted" (the sender).

    Parameters
    ----------
    types : types of frames to return
    count : called with a counter and an increment
    """

    def __init__(self, types: Collection[int], count: Count) -> None:
        cobs = extra("cobs.cobs")
        self._decode, self._error = cobs.decode, cobs.DecodeError
        self._types, self._count = frozenset(types), count
        self._boot, self._last = -1, -1  # boot and sequence of the sender; -1: unknown
        self._late: list[int] = []
        self.restart()

    def restart(self, keep_sequence: bool = True) -> None:
        """Begin with a new connection: the bytes before the first zero may be part of a frame.

        Parameters
        ----------
        keep_sequence : count the frames lost meanwhile; not if the sequence may have wrapped
        """
        self._wire, self._too_long, self._at_start = b"", False, True
        if not keep_sequence:
            self._boot = self._last = -1

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete."""
        *ended, rest = data.split(b"\0")
        frames = []
        for piece in ended:
            self._append(piece)
            frame = self._end_frame()
            if frame is not None:
                frames.append(frame)
        self._append(rest)
        return frames

    def _append(self, piece: bytes) -> None:
        if self._too_long or len(self._wire) + len(piece) > _MAX_WIRE_SIZE:
            self._wire, self._too_long = b"", True  # not a frame: drop all up to the next zero
        else:
            self._wire += piece

    def _end_frame(self) -> Frame | None:
        """Return the frame before a zero, None if it is invalid or out of order."""
        wire, too_long, at_start = self._wire, self._too_long, self._at_start
        self._wire, self._too_long, self._at_start = b"", False, False
        if not wire and not too_long:
            return None  # senders may send extra zeros to clear the line
        body = self._body(wire)
        if body is None:
            self._count("fragment" if at_start else "corrupt", 1)
            return None
        version, kind, boot, sequence = _HEADER.unpack_from(body)
        if version != VERSION:
            self._count("unknown version", 1)
            return None
        return self._accept(Frame(kind, boot, sequence, body[_HEADER.size : -_CRC.size]))

    def _body(self, wire: bytes) -> bytes | None:
        """Return the decoded bytes of a frame, None if they are corrupt."""
        try:
            body: bytes = self._decode(wire)
        except self._error:
            return None
        whole = (
            len(body) >= _MIN_SIZE and binascii.crc_hqx(body[:-2], 0) == _CRC.unpack(body[-2:])[0]
        )
        return body if whole else None

    def _accept(self, frame: Frame) -> Frame | None:
        """Return a frame if its type is known and it is in sequence, else None."""
        if not self._is_new(frame):
            return None
        self._boot, self._last = frame.boot, frame.sequence
        self._late.clear()
        if frame.type not in self._types:
            self._count("unknown type", 1)
            return None
        self._count("frames", 1)
        return frame

    def _is_new(self, frame: Frame) -> bool:
        if frame.boot != self._boot:
            if self._boot >= 0:
                self._count("restarted", 1)
            return True
        ahead = (frame.sequence - self._last) % 65536
        if ahead == 0:
            self._count("repeated", 1)
            return False
        if ahead < _HALF:
            if ahead > 1:
                self._count("lost", ahead - 1)
            return True
        return self._has_restarted(frame.sequence)

    def _has_restarted(self, sequence: int) -> bool:
        """Return whether consecutive late frames show a restart under the same boot number."""
        if self._late and sequence != (self._late[-1] + 1) % 65536:
            self._late.clear()
        self._late.append(sequence)
        if len(self._late) < RESTART_FRAMES:
            self._count("late", 1)
            return False
        self._count("restarted", 1)
        return True
