"""Commands from many threads are sent whole and in order; a dead port blocks nobody."""

import contextlib
import math
import os
import socket
import threading
import time
from collections import Counter

import pytest

from impslam.platform.devices import autopilot_link
from impslam.platform.devices.autopilot_link import CommandLink
from impslam.platform.devices.autopilot_messages import (
    COMMANDS,
    Ack,
    DriveCommand,
    FrameType,
    Result,
)
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.framing import Decoder


class Port:
    """One end of a socket pair, with the interface of pyserial's ports."""

    port = "pair"

    def __init__(self, end):
        self._end = end

    def fileno(self):
        return self._end.fileno()


class Firmware:
    """The other end, which reads frames."""

    def __init__(self, end):
        self.end, self.counts, self.frames = end, Counter(), []
        end.setblocking(False)
        self.decoder = Decoder(COMMANDS, lambda what, n: self.counts.update({what: n}))

    def read(self):
        try:
            got = self.decoder.feed(self.end.recv(1 << 20))
        except BlockingIOError:
            return []
        self.frames += got
        return got


def fill(descriptor):
    """Write until the port is full."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(descriptor, bytes(1 << 16))


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        yield Port(ours), Firmware(theirs)


@pytest.fixture
def counts():
    return Counter()


@pytest.fixture
def link(pair, counts):
    link = CommandLink(lambda what, n: counts.update({what: n}))
    link.attach(pair[0])
    return link


def test_commands_of_many_threads_go_out_whole_and_in_order(pair, link, counts):
    _, firmware = pair

    def work(number):
        for step in range(100):
            link.drive(0.001 * number, 0.001 * step)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        firmware.read()
    firmware.read()
    assert firmware.counts == {"frames": 800}
    assert counts["commands"] == 800
    drives = [DriveCommand.parse(frame.payload) for frame in firmware.frames]
    for number in range(8):  # each thread's own in the order in which it gave them
        assert [d.right for d in drives if d.left == number] == list(range(100))


def test_no_drive_is_sent_from_a_stop_until_the_release(pair, link, counts):
    _, firmware = pair
    link.drive(0.1, 0.1)
    link.stop(True)
    link.drive(0.1, 0.1)
    link.stop(False)
    link.drive(0.1, 0.1)
    kinds = [frame.type for frame in firmware.read()]
    assert kinds == [FrameType.DRIVE, FrameType.STOP, FrameType.RELEASE, FrameType.DRIVE]
    assert counts["drive held back"] == 1


def test_a_stop_is_repeated_every_twentieth_of_a_second_until_its_own_answer(pair, link):
    _, firmware = pair
    start = autopilot_link.now()
    link.update(start)
    link.stop(True)
    for step in range(1, 31):
        link.update(start + 0.01 * step)
    stops = [frame for frame in firmware.read() if frame.type == FrameType.STOP]
    assert len(stops) in {6, 7}
    refused = Ack(FrameType.STOP, Result.UNKNOWN, stops[0].sequence, 0)
    other = Ack(FrameType.DRIVE, Result.DONE, stops[1].sequence, 0)
    for ack in (refused, other):
        link.on_ack(ack, start)
    link.update(start + 0.5)
    assert firmware.read()
    link.on_ack(Ack(FrameType.STOP, Result.DONE, stops[2].sequence, 0), start + 0.5)
    link.update(start + 0.9)
    assert not firmware.read()


def test_the_answer_to_an_earlier_stop_does_not_end_the_repeating(pair, link):
    _, firmware = pair
    start = autopilot_link.now()
    link.update(start)
    for wanted in (True, False, True):
        link.stop(wanted)
    first, _, second = [frame for frame in firmware.read() if frame.type != FrameType.SET_TIME]
    link.on_ack(Ack(FrameType.STOP, Result.DONE, first.sequence, 0), start)
    link.update(start + 0.5)
    (again,) = firmware.read()
    assert again.type == FrameType.STOP
    link.on_ack(Ack(FrameType.STOP, Result.DONE, second.sequence, 0), start + 0.5)
    link.update(start + 0.9)
    assert not firmware.read()


def test_a_stop_requested_while_lost_is_sent_after_reconnection(pair, counts):
    port, firmware = pair
    link = CommandLink(lambda what, n: counts.update({what: n}))
    link.stop(True)
    link.drive(0.1, 0.1)
    assert counts == {"commands not sent": 1, "drive held back": 1}
    link.attach(port)
    link.update(autopilot_link.now())
    assert [frame.type for frame in firmware.read()] == [FrameType.STOP, FrameType.SET_TIME]


def test_a_full_port_does_not_block_for_long_and_is_reported(pair, link, counts):
    port, _ = pair
    fill(port.fileno())
    begin = time.monotonic()
    for _ in range(100):
        link.drive(0.1, 0.1)
    assert time.monotonic() - begin < 0.5
    assert counts == {"commands not sent": 100}
    with pytest.raises(DeviceError, match="accepts no more data"):
        link.update(autopilot_link.now())


def test_unanswered_commands_are_counted(pair, link, counts):
    link.drive(0.1, 0.1)
    link.update(autopilot_link.now() + 2.0)
    assert counts["commands unanswered"] == 2  # the drive, and the time that was set
    link.drive(0.1, 0.1)
    link.attach(pair[0])
    assert counts["commands unanswered"] == 3
    link.on_ack(Ack(FrameType.DRIVE, Result.DONE, 0, 0), 0.0)
    assert counts["answers to nothing"] == 1


def test_each_connection_is_a_new_sender(pair, link):
    _, firmware = pair
    link.drive(0.1, 0.1)
    link.attach(pair[0])
    link.drive(0.2, 0.2)
    first, second = firmware.read()
    assert second.boot == (first.boot + 1) % 256
    assert (first.sequence, second.sequence) == (0, 0)
    assert firmware.counts == {"frames": 2, "restarted": 1}


def test_round_trips_of_answers_are_recorded(pair, link):
    _, firmware = pair
    assert all(math.isnan(value) for value in link.latency())
    for number in range(100):
        link.drive(0.1, 0.1)
        (frame,) = firmware.read()
        delay = 0.5 if number == 7 else 0.01
        link.on_ack(
            Ack(FrameType.DRIVE, Result.DONE, frame.sequence, 0), autopilot_link.now() + delay
        )
    median, high = link.latency()
    assert median == pytest.approx(0.01, abs=0.01)
    assert 0.01 < high < 0.5
