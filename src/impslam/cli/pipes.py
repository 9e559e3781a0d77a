"""Output into a pipe whose reader may leave, as `imp run LOG | head` does: the command goes on."""

from __future__ import annotations

import errno
import io
import sys
from typing import Any, BinaryIO, TextIO, cast

GONE = frozenset({errno.EPIPE, errno.EINVAL})
"""What writing to a pipe without a reader fails with; on Windows it is EINVAL."""


class _Pipe(io.FileIO):
    """Drops what is written once nobody reads."""

    def write(self, data: Any, /) -> int:
        """Write, or drop, all bytes; return their number."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in GONE:
                raise
            return memoryview(data).nbytes


def outlive_readers() -> None:
    """Let stdout and stderr drop what is written after their reader has left."""
    sys.stdout, sys.stderr = _outliving(sys.stdout), _outliving(sys.stderr)


def _outliving(stream: TextIO) -> TextIO:
    """Return the stream of a pipe with that behaviour, any other one as it is.

    It is unbuffered if the stream is, as with `PYTHONUNBUFFERED` in a systemd unit.
    """
    if not isinstance(stream, io.TextIOWrapper) or stream.isatty():
        return stream
    pipe = _Pipe(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        cast("BinaryIO", pipe) if stream.write_through else io.BufferedWriter(pipe),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
