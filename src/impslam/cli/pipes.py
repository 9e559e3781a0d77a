"""Output to a pipe that its reader may close, as in `imp run LOG | head`: the command continues."""

from __future__ import annotations

import errno
import io
import sys
from typing import Any, BinaryIO, TextIO, cast

BROKEN_PIPE_ERRORS = frozenset({errno.EPIPE, errno.EINVAL})
"""Error numbers of writing to a pipe without a reader; Windows reports EINVAL."""


class _TolerantPipe(io.FileIO):
    """Discards output once the pipe has no reader."""

    def write(self, data: Any, /) -> int:
        """Write or discard all bytes; return their number."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in BROKEN_PIPE_ERRORS:
                raise
            return memoryview(data).nbytes


def ignore_broken_pipes() -> None:
    """Make stdout and stderr discard output after their reader has closed the pipe."""
    sys.stdout, sys.stderr = _tolerant(sys.stdout), _tolerant(sys.stderr)


def _tolerant(stream: TextIO) -> TextIO:
    """Return a stream that ignores a broken pipe; return terminals and other streams unchanged.

    It is unbuffered if the stream is, e.g. with `PYTHONUNBUFFERED` in a systemd unit.
    """
    if not isinstance(stream, io.TextIOWrapper) or stream.isatty():
        return stream
    pipe = _TolerantPipe(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        cast("BinaryIO", pipe) if stream.write_through else io.BufferedWriter(pipe),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
