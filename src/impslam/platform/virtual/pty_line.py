"""A line that is a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

from impslam.platform.virtual.line import CHUNK, Line

if sys.platform != "win32":  # where `TcpLine` serves
    import termios
    import tty


class PtyLine(Line):
    """A pseudo-terminal behind a symbolic link, which keeps its name when it is plugged in again."""

    def __init__(self, path: Path, seed: int = 0, baud: int = 0) -> None:
        super().__init__(seed, baud)
        self._path = path
        self._host_open = False
        self._plug()

    @property
    def url(self) -> str:
        """Path of the link."""
        return str(self._path)

    def _plug(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._slave = os.ttyname(slave)
        os.close(slave)  # so that reads report whether a host has it open
        os.set_blocking(self._master, False)
        fresh = self._path.with_name(self._path.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._slave)
        fresh.replace(self._path)

    def _pull(self) -> None:
        self._path.unlink(missing_ok=True)
        os.close(self._master)
        self._host_open = False

    def _read(self) -> bytes:
        try:
            data = os.read(self._master, CHUNK)
        except BlockingIOError:
            data = b""
        except OSError:  # EIO: no host has it open
            if self._host_open:
                self._flush()
            self._host_open = False
            return b""
        self._host_open = True
        return data

    def _write(self, data: bytes) -> int | None:
        if not self._host_open:
            return None
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
        except OSError:  # the host has just closed it
            return None

    def _flush(self) -> None:
        """Discard the bytes that the last host has not read, or the next one would read them."""
        with contextlib.suppress(OSError):
            slave = os.open(self._slave, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            termios.tcflush(slave, termios.TCIOFLUSH)
            os.close(slave)
