"""The thread of a device survives all errors of the hardware, and counts them."""

import threading
import time
from collections.abc import Callable
from queue import Queue

import pytest
from pydantic import PrivateAttr

from impslam.platform.devices.base import Device, DeviceError, Reading, now
from impslam.types import Climate, Event


class Toy(Device):
    """Runs a script of the test, one function per session."""

    name = "toy"
    _script: Queue[Callable[["Toy"], None]] = PrivateAttr(default_factory=Queue)
    _sessions: int = PrivateAttr(default=0)

    def _serve(self) -> None:
        self._sessions += 1
        act = self._script.get() if not self._script.empty() else Toy.idle
        act(self)

    def idle(self) -> None:
        self._ready("toy 1.0")
        self._stopping.wait()

    def speak(self) -> None:
        self._deliver(Climate(now(), 20.0, 0.5), now(), 1.5)

    def fail(self) -> None:
        raise DeviceError("/dev/toy: no such port; plug it in")

    def break_down(self) -> None:
        raise ZeroDivisionError("oops")


def until(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)


@pytest.fixture
def toy():
    device = Toy(retry=0.01, timeout=0.2)
    yield device
    device.stop()


def test_the_time_base_does_not_depend_on_the_wall_clock(monkeypatch):
    before = now()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert 0.0 <= now() - before < 1.0


def test_a_reading_reaches_the_receiver_with_both_clocks(toy):
    got: list[Reading] = []
    toy._script.put(lambda self: (self._ready("toy 1.0"), self.speak(), self._stopping.wait()))
    toy.start(got.append)
    until(lambda: len(got) == 2)
    notice, reading = got
    assert isinstance(notice.message, Event)
    assert notice.message.text == "toy 1.0"
    assert isinstance(reading.message, Climate)
    assert (reading.device, reading.device_stamp) == ("toy", 1.5)
    health = toy.health()
    assert (health.state, health.detail) == ("ok", "toy 1.0")
    assert health.counts["Climate"] == 1
    assert health.rates["Climate"] == 0.5  # one in two seconds


def test_a_lost_device_is_reopened_and_notified_once_per_reason(toy):
    got: list[Reading] = []
    for _ in range(3):
        toy._script.put(Toy.fail)
    toy.start(got.append)
    until(lambda: toy.health().state == "ok")
    texts = [reading.message.text for reading in got]
    assert texts == ["/dev/toy: no such port; plug it in", "toy 1.0"]
    assert toy.health().counts["lost connection"] == 1
    assert toy._sessions == 4


def test_alternating_reasons_of_a_loss_are_notified_once_each(toy):
    got: list[Reading] = []
    for _ in range(3):
        toy._script.put(Toy.fail)
        toy._script.put(Toy.break_down)
    toy._script.put(lambda self: (self._ready("toy 1.0"), self.fail()))  # another loss
    toy.start(got.append)
    until(lambda: toy._sessions == 8 and toy.health().state == "ok")
    texts = [reading.message.text for reading in got]
    lost, bug = "/dev/toy: no such port; plug it in", "ZeroDivisionError: oops; please report it"
    assert texts == [lost, bug, "toy 1.0", lost, "toy 1.0"]


def test_each_loss_is_counted_but_not_the_attempts_to_reopen(toy):
    for _ in range(2):
        toy._script.put(lambda self: (self._ready("toy 1.0"), self.fail()))
        toy._script.put(Toy.fail)
        toy._script.put(Toy.break_down)  # another reason, but the same loss
    toy.start(lambda reading: None)
    until(lambda: toy._sessions == 7 and toy.health().state == "ok")
    assert toy.health().counts["lost connection"] == 2


def test_the_error_is_readable_while_the_device_is_retried(toy):
    toy._script.put(Toy.fail)
    resume = threading.Event()
    toy._script.put(lambda self: (resume.wait(), self.idle()))
    toy.start(lambda reading: None)
    until(lambda: toy._sessions == 2)
    health = toy.health()
    assert (health.state, health.detail) == ("lost", "/dev/toy: no such port; plug it in")
    resume.set()
    until(lambda: toy.health().state == "ok")


def test_a_bug_does_not_end_the_thread(toy, caplog):
    toy._script.put(Toy.break_down)
    toy.start(lambda reading: None)
    until(lambda: toy.health().state == "ok")
    assert "ZeroDivisionError" in caplog.text


def test_an_open_device_without_messages_is_silent(toy):
    toy.start(lambda reading: None)
    until(lambda: toy.health().state == "ok")
    until(lambda: toy.health().state == "silent")


def test_it_stops_and_can_be_started_again(toy):
    toy.start(lambda reading: None)
    until(lambda: toy.health().state == "ok")
    toy.stop()
    assert toy.health().state == "stopped"
    assert not [thread for thread in threading.enumerate() if thread.name == "toy"]
    toy.start(lambda reading: None)
    until(lambda: toy.health().state == "ok")
    with pytest.raises(RuntimeError, match="started already"):
        toy.start(lambda reading: None)


def test_a_receiver_that_fails_does_not_disturb_the_device(toy, caplog):
    def fail(reading):
        raise ZeroDivisionError("oops")

    toy._script.put(
        lambda self: [self._ready("toy 1.0"), *(self.speak() for _ in range(5)), self.idle()]
    )
    toy.start(fail)
    until(
        lambda: toy.health().counts["Climate"] == 5 if "Climate" in toy.health().counts else False
    )
    health = toy.health()
    assert health.state == "ok"
    assert "lost connection" not in health.counts
    assert health.counts["not received: error"] >= 6
    assert caplog.text.count("Traceback") == 1


def test_a_lost_device_and_a_receiver_that_fails_leave_the_thread_alive(toy):
    def fail(reading):
        raise ZeroDivisionError("oops")

    toy._script.put(Toy.fail)
    toy.start(fail)
    until(lambda: toy.health().state == "ok")
