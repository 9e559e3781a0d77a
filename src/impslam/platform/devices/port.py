"""Byte ports: serial lines, pseudo-terminals and TCP connections with one interface.

pyserial comes with the `robot` extra and is imported when the first port is opened, as mapping logs
does not need it.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import select
import socket
import time
import urllib.parse
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING

from impslam.extras import install
from impslam.platform.devices.base import DeviceError

if TYPE_CHECKING:
    import serial

IO_TIMEOUT = 0.05  # s of a read or a write: a quarter of the time in which a device must stop
CHUNK = 4096  # bytes, one page: the buffer of a tty

_ADVICE = {
    errno.ENOENT: "no such port; plug it in, and see `ls /dev/serial/by-id`",
    errno.ENODEV: "the device has been unplugged; plug it in",
    errno.ENXIO: "the device has been unplugged; plug it in",
    errno.EACCES: "not allowed; add the user to the group dialout and log in again",
    errno.EPERM: "not allowed; add the user to the group dialout and log in again",
    errno.EAGAIN: "another program has it open; close that one",
    errno.EBUSY: "another program has it open; close that one",
    errno.EIO: "the connection has failed; check the plug",
    errno.ENOTTY: "not a serial port; check the path",
    errno.ECONNREFUSED: "connection refused; check its supply and the port number",
    errno.EHOSTUNREACH: "cannot be reached; check its address, its supply and the network",
    errno.ENETUNREACH: "cannot be reached; check its address, its supply and the network",
    errno.ETIMEDOUT: "does not answer; check its address, its supply and the network",
}
_LOOKUP_ADVICE = {  # separate, as on other systems than Linux these numbers may equal those above
    socket.EAI_NONAME: "no such host; check its name, or give its address",
    socket.EAI_AGAIN: "its name cannot be resolved; check the network, or give its address",
}


def extra(module: str) -> ModuleType:
    """Import a module that comes with the `robot` extra.

    Raises
    ------
    DeviceError
        If the extra is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise DeviceError(
            f"{module} is not installed; install it with: {install('robot')}"
        ) from error


def open_port(url: str, baud: int) -> serial.SerialBase:
    """Open a port: "/dev/ttyUSB0", a pseudo-terminal's path, or "socket://host:port" (TCP).

    It is locked against other programs if the system supports it. Reads and writes end after
    `IO_TIMEOUT`. `baud` is ignored over TCP.

    Raises
    ------
    DeviceError
        If it cannot be opened; the message says what to do.
    """
    pyserial = extra("serial")
    _check_url(url)
    try:
        port: serial.SerialBase = pyserial.serial_for_url(
            url, baudrate=baud, timeout=IO_TIMEOUT, write_timeout=IO_TIMEOUT, exclusive=True
        )
        if url.startswith("socket://"):
            _disable_nagle(port)
    except (OSError, ValueError, OverflowError) as error:
        raise _device_error(url, "cannot be opened", error) from error
    return port


@contextlib.contextmanager
def opened(url: str, baud: int) -> Iterator[serial.SerialBase]:
    """Open a port as `open_port` does, and close it in every case."""
    port = open_port(url, baud)
    connection = getattr(port, "_socket", None)
    try:
        yield port
    finally:
        port.close()
        if connection is not None:
            connection.close()  # pyserial 3.5 does not close one after the other end hung up


def read_some(port: serial.SerialBase, wait: float = IO_TIMEOUT) -> bytes:
    """Return the available bytes, after waiting at most `wait` s for the first one.

    pyserial's `read` waits for a number of bytes; this one returns them as soon as they arrive.

    Raises
    ------
    DeviceError
        If the port is lost.
    """
    try:
        ready, _, _ = select.select([port.fileno()], [], [], wait)
        if not ready:
            return b""
        data = os.read(port.fileno(), CHUNK)
    except BlockingIOError:  # pragma: no cover  # readiness may be spurious: select(2), BUGS
        return b""
    except (OSError, ValueError, TypeError) as error:  # pyserial's of a port closed meanwhile
        raise _device_error(port.port, "has been lost", error) from error
    if not data:
        raise DeviceError(
            f"{port.port}: has been lost: the other end closed the connection; check the plug"
        )
    return data


def write_all(port: serial.SerialBase, data: bytes) -> None:
    """Write all bytes within `IO_TIMEOUT`.

    pyserial's `write` busy-waits on a full port; this one sleeps.

    Raises
    ------
    DeviceError
        If the port is lost or does not accept all bytes in time; some may have been written.
    """
    end, left = time.monotonic() + IO_TIMEOUT, memoryview(data)
    try:
        while left:
            _, ready, _ = select.select([], [port.fileno()], [], max(0.0, end - time.monotonic()))
            if not ready:
                raise DeviceError(f"{port.port}: accepts no more data; check the device")
            left = left[os.write(port.fileno(), left) :]
    except (OSError, ValueError, TypeError) as error:  # pyserial's of a port closed meanwhile
        raise _device_error(port.port, "cannot be written to", error) from error


def _check_url(url: str) -> None:
    """Raise if the address of a TCP connection has no valid port; pyserial's message does not tell."""
    if url.startswith("socket://"):
        try:
            if urllib.parse.urlsplit(url).port:
                return
        except ValueError:  # not a number, or too large
            pass
        raise DeviceError(
            f"{url}: cannot be opened: give socket://HOST:PORT, with a port from 1 to 65535"
        )


def _disable_nagle(port: serial.SerialBase) -> None:
    """Send small writes at once, not after earlier ones are acknowledged (Nagle's algorithm)."""
    with socket.socket(fileno=os.dup(port.fileno())) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _device_error(url: str | None, what: str, error: Exception) -> DeviceError:
    return DeviceError(f"{url}: {what}: {_advice(error) or _reason(error)}")


def _advice(error: Exception) -> str:
    """Return what to do about an error of the system, which pyserial may have wrapped."""
    for one in (error, error.__context__):
        first = one.args[0] if one is not None and one.args else None
        if isinstance(first, int):  # of an OSError, or of termios.error, which is not an OSError
            advice = _LOOKUP_ADVICE if isinstance(one, socket.gaierror) else _ADVICE
            return advice.get(first, "")
    return ""


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{text or type(error).__name__}; check the port's name, its plug and its supply"
