"""Byte ports open, read and write in time, and report errors in one line."""

import contextlib
import errno
import importlib
import os
import socket
import sys
import time
import tty

import pytest

from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.port import IO_TIMEOUT, extra, open_port, read_some, write_all

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


@pytest.fixture
def pty():
    """Return the master's descriptor and the path of a pseudo-terminal."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        with contextlib.suppress(OSError):
            os.close(descriptor)


@pytest.fixture
def tcp():
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_bytes_pass_both_ways_unchanged_on_a_pseudo_terminal(pty):
    master, path = pty
    every = bytes(range(256))
    with open_port(path, 460800) as port:
        os.write(master, every)
        got = b""
        while len(got) < 256:
            got += read_some(port, 1.0)
        assert got == every
        write_all(port, every)
        got = b""
        while len(got) < 256:
            got += os.read(master, 256)
        assert got == every


def test_bytes_pass_both_ways_over_tcp_at_once(tcp):
    server, url = tcp
    with open_port(url, 19200) as port:
        peer, _ = server.accept()
        with peer:
            write_all(port, b"VV\n")
            assert peer.recv(16) == b"VV\n"
            peer.sendall(b"00P\n")
            assert read_some(port, 1.0) == b"00P\n"
            with socket.socket(fileno=os.dup(port.fileno())) as same:
                assert same.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_nothing_to_read_ends_after_the_wait(pty):
    with open_port(pty[1], 115200) as port:
        begin = time.monotonic()
        assert read_some(port, 0.02) == b""
        assert 0.015 < time.monotonic() - begin < 1.0


def test_a_second_program_is_refused(pty):
    with open_port(pty[1], 115200), pytest.raises(DeviceError, match="another program has it open"):
        open_port(pty[1], 115200)


def test_a_missing_port_is_an_error(tmp_path):
    with pytest.raises(DeviceError, match=r"ttyNONE: cannot be opened: no such port; plug it in"):
        open_port(str(tmp_path / "ttyNONE"), 115200)


def test_a_file_is_not_a_port(tmp_path):
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(DeviceError, match="cannot be opened"):
        open_port(str(path), 115200)


def test_a_port_without_permission_is_an_error(monkeypatch):
    serial = importlib.import_module("serial")

    def refuse(*_, **__):
        raise serial.SerialException(errno.EACCES, "Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(DeviceError, match="add the user to the group dialout"):
        open_port("/dev/ttyUSB0", 115200)


@pytest.mark.parametrize(
    ("url", "advice"),
    [
        ("socket://127.0.0.1:1", "connection refused"),
        ("socket://nowhere.invalid:10940", "(no such host|its name cannot be resolved)"),
        ("/dev/null", "not a serial port"),
    ],
)
def test_the_system_s_reason_is_found_behind_pyserial_s(url, advice):
    with pytest.raises(DeviceError, match=f"^{url}: cannot be opened: {advice}; check [^;]*$"):
        open_port(url, 115200)


def test_a_failed_lookup_is_not_taken_for_a_missing_port(monkeypatch):
    """Lookups have separate error numbers: on macOS, a name server's silence has that of ENOENT."""
    serial = importlib.import_module("serial")

    def refuse(*_, **__):
        try:
            raise socket.gaierror(errno.ENOENT, "Temporary failure in name resolution")
        except OSError:
            raise serial.SerialException("Temporary failure in name resolution")  # noqa: B904

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(DeviceError, match="cannot be opened: Temporary failure"):
        open_port("socket://lidar:10940", 115200)


@pytest.mark.parametrize("url", ["socket://127.0.0.1:1", "socket://127.0.0.1", "what://ever", ""])
def test_a_port_that_cannot_be_opened_is_a_one_line_error(url):
    with pytest.raises(DeviceError) as caught:
        open_port(url, 115200)
    assert "\n" not in str(caught.value)
    assert "cannot be opened" in str(caught.value)


@pytest.mark.parametrize("port", ["", ":", ":0", ":99999", ":scip"])
def test_a_tcp_address_without_a_valid_port_is_explained(port):
    with pytest.raises(DeviceError, match="give socket://HOST:PORT, with a port from 1 to 65535"):
        open_port(f"socket://127.0.0.1{port}", 115200)


def test_an_impossible_baud_rate_is_an_error(pty):
    with pytest.raises(DeviceError, match="cannot be opened"):
        open_port(pty[1], -1)


def test_a_pulled_plug_is_reported_by_reads_and_writes(pty):
    master, path = pty
    with open_port(path, 115200) as port:
        os.close(master)
        with pytest.raises(DeviceError, match="has been lost"):
            read_some(port, 1.0)
        with pytest.raises(DeviceError, match="cannot be written to"):
            write_all(port, b"x")


def test_a_tcp_peer_that_hangs_up_is_an_error(tcp):
    server, url = tcp
    with open_port(url, 115200) as port:
        server.accept()[0].close()
        with pytest.raises(DeviceError, match="closed the connection"):
            read_some(port, 1.0)


def test_a_closed_port_is_an_error(pty):
    port = open_port(pty[1], 115200)
    port.close()
    with pytest.raises(DeviceError):
        read_some(port)
    with pytest.raises(DeviceError):
        write_all(port, b"x")


def test_a_write_to_a_full_port_times_out(pty):
    with open_port(pty[1], 115200) as port:
        begin, spent = time.monotonic(), time.process_time()
        with pytest.raises(DeviceError, match="accepts no more data"):
            write_all(port, bytes(1 << 20))
        assert time.monotonic() - begin < IO_TIMEOUT + 1.0
        assert time.process_time() - spent < 0.5 * IO_TIMEOUT  # it slept


def test_a_partial_write_is_continued(tcp):
    server, url = tcp
    data = os.urandom(1 << 16)
    with open_port(url, 115200) as port:
        peer, _ = server.accept()
        with peer:
            write_all(port, data)
            got = b""
            while len(got) < len(data):
                got += peer.recv(1 << 16)
    assert got == data


def test_a_missing_extra_is_reported_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(DeviceError, match=r"pip install .*(pyserial|impslam\[robot\])"):
        open_port("/dev/ttyUSB0", 115200)
    with pytest.raises(DeviceError, match=r"cobs\.nothing is not installed"):
        extra("cobs.nothing")
