"""Lines: bytes arrive as sent; an unplugged port comes back under its name."""

import socket
import time
from pathlib import Path

import numpy as np
import pytest

from impslam.errors import ImpError
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.port import open_port, read_some, write_all
from impslam.platform.virtual.line import Line
from impslam.platform.virtual.pty_line import PtyLine
from impslam.platform.virtual.tcp_line import TcpLine

pytest.importorskip("serial")


@pytest.fixture(params=["pty", "tcp"])
def line(request, tmp_path):
    made = PtyLine(tmp_path / "device", 1) if request.param == "pty" else TcpLine(seed=1)
    yield made
    made.close()


def until(condition, seconds: float = 5.0) -> None:
    """Wait for the kernel."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "has not happened"
        time.sleep(0.001)


def connect(line: Line):
    port = open_port(line.url, 115200)
    write_all(port, b"?")
    received = bytearray()
    until(lambda: received.extend(line.receive(0.0)) or received == b"?")
    return port


def read(port, number: int) -> bytes:
    data = bytearray()
    until(lambda: data.extend(read_some(port, 0.01)) or len(data) >= number)
    return bytes(data + read_some(port, 0.0))


def test_all_bytes_pass_both_ways(line):
    everything = bytes(range(256)) * 8
    with connect(line) as port:
        line.send(everything, 0.0)
        assert read(port, len(everything)) == everything
        write_all(port, everything)
        received = bytearray()
        until(lambda: received.extend(line.receive(0.0)) or len(received) >= len(everything))
        assert received == everything
    assert line.counts["sent"] == len(everything)
    assert line.counts["received"] == len(everything) + 1


def test_bytes_without_a_host_are_counted_and_dropped(line):
    line.send(b"early", 0.0)
    with connect(line) as port:
        line.send(b"one", 0.0)
        assert read(port, 3) == b"one"
        line.send(b"unread", 0.0)
    until(lambda: line.receive(0.0) == b"" and not received(line))
    with connect(line) as port:
        line.send(b"two", 0.0)
        assert read(port, 3) == b"two"
    assert line.counts["unheard"] >= 5


def received(line: Line) -> bool:
    before = line.counts["unheard"]
    line.send(b".", 0.0)
    return line.counts["unheard"] == before


def test_what_the_host_does_not_take_is_lost_and_counted(line):
    with connect(line):
        for _ in range(200):
            line.send(bytes(65536), 0.0)
    assert line.counts["overrun"] > 0
    assert line.counts["sent"] + line.counts["overrun"] == 200 * 65536


def test_unplugging_ends_the_connection_and_plugging_in_keeps_the_name(line):
    url, before = line.url, descriptors()
    for _ in range(4):  # pyserial waits 0.3 s whenever it closes a socket
        port = connect(line)
        line.unplug(1.0)
        line.send(b"lost", 0.5)
        assert line.receive(0.5) == b""
        with pytest.raises(DeviceError):
            read_some(port, 2.0)
        with pytest.raises(DeviceError):
            open_port(url, 115200)
        port.close()
        line.receive(1.0)
        assert line.url == url
        with connect(line) as port:
            line.send(b"again", 1.0)
            assert read(port, 5) == b"again"
        until(lambda: line.receive(1.0) == b"" and not received(line))
    assert line.counts["unplugged"] == 4 * 4
    assert descriptors() == before


def descriptors() -> int:
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.exists() else 0


def test_counted_noise_matches_the_received_bytes(line):
    sent = bytes(2000)
    with connect(line) as port:
        line.noise(0.02, "flip", until=1.0)
        line.send(sent, 0.5)
        arrived = np.frombuffer(read(port, len(sent)), np.uint8)
        assert np.count_nonzero(arrived) == line.counts["flip"] > 0
        line.send(sent, 1.0)
        assert read(port, len(sent)) == sent


def test_noise_corrupts_bytes_of_the_host_too(line):
    with connect(line) as port:
        line.noise(1.0, "drop", until=1.0)
        write_all(port, b"never heard")
        until(lambda: line.receive(0.5) == b"" and line.counts["drop"] == 11)
        write_all(port, b"heard")
        until(lambda: line.receive(1.0) == b"heard")


def test_a_delay_ends_in_a_burst(line):
    with connect(line) as port:
        line.hold(1.0)
        line.send(b"one ", 0.1)
        line.send(b"two ", 0.9)
        assert read_some(port, 0.02) == b""
        line.send(b"", 1.0)
        assert read(port, 8) == b"one two "


def test_a_uart_delays_bytes(tmp_path):
    line = PtyLine(tmp_path / "uart", baud=115200)  # 10 bits a byte: 86.8 us
    port = open_port(line.url, 115200)
    line.receive(0.0)
    line.send(bytes(100), 1.0)
    line.send(bytes(50), 1.001)
    for now, arrived in ((1.008, 0), (1.009, 100), (1.0130, 100), (1.0131, 150)):
        line.send(b"", now)
        assert line.counts["sent"] == arrived
    write_all(port, bytes(20))
    time.sleep(0.05)  # for the kernel to pass them on
    assert line.receive(2.0) == b""
    assert line.receive(2.0017) == b""
    assert line.receive(2.0018) == bytes(20)
    line.send(b"lost", 3.0)
    line.unplug(4.0)
    line.receive(4.0)
    line.send(b"", 5.0)
    assert line.counts["sent"] == 150
    port.close()
    line.close()


def test_nothing_is_left_after_closing(tmp_path):
    before = descriptors()
    lines = [PtyLine(tmp_path / "a"), PtyLine(tmp_path / "b"), TcpLine(), TcpLine()]
    lines[1].unplug(1.0)
    lines[3].unplug(1.0)
    url = lines[2].url
    for made in lines:
        made.close()
        made.close()
    assert descriptors() == before
    assert not list(tmp_path.iterdir())
    with pytest.raises(DeviceError):
        open_port(url, 115200)


def test_a_used_port_is_refused():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen(1)
        with pytest.raises(ImpError, match="choose another"):
            TcpLine(other.getsockname()[1])


def test_a_host_that_is_killed_makes_room_for_the_next():
    line = TcpLine()
    host = connect(line)
    host._socket.close()
    until(lambda: line.receive(0.0) == b"" and not received(line))
    with connect(line):
        assert received(line)
    line.close()
