"""What every device keeps: it is made without hardware, gives up in one line, and tries again."""

import threading
import time

import pytest

from impslam.component import build, components
from impslam.platform.devices.base import Device, DeviceError, DriveDevice

WHERE = ("port", "source")
"""The parameter that says where a device is."""


def make(name, tmp_path, **more):
    """Return a device at a place where nothing is."""
    fields = components("device")[name].model_fields
    (where,) = [field for field in WHERE if field in fields]
    return build("device", {"kind": name, where: str(tmp_path / "gone"), "retry": 0.02, **more})


@pytest.fixture(params=sorted(components("device")))
def device(request, tmp_path):
    made = make(request.param, tmp_path)
    yield made
    made.stop()


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)


def test_it_is_made_without_hardware_and_counts_nothing(device):
    assert isinstance(device, Device)
    health = device.health()
    assert (health.state, health.counts, health.rates) == ("stopped", {}, {})
    assert device.title == device.name


def test_its_name_may_be_chosen(device, tmp_path):
    assert make(device.name, tmp_path, label="left one").title == "left one"


def test_nothing_there_is_one_line_that_names_the_place(device, tmp_path):
    with pytest.raises(DeviceError) as error:
        device._serve()
    said = str(error.value)
    assert str(tmp_path / "gone") in said
    assert "\n" not in said
    assert len(said) < 300


@pytest.fixture
def attempts(device, monkeypatch):
    """The attempts to open the device, one entry each."""
    begun, serve = [], type(device)._serve
    monkeypatch.setattr(type(device), "_serve", lambda self: (begun.append(1), serve(self)))
    return begun


def test_a_lost_device_is_tried_again_and_counted_once(device, attempts):
    told = []
    device.start(told.append)
    until(lambda: len(attempts) > 3)
    health = device.health()
    assert health.state == "lost"
    assert health.counts["lost connection"] == 1
    assert "\n" not in health.detail
    assert [reading.message.level for reading in told] == ["error"]  # in words once
    assert told[0].message.text == health.detail
    assert told[0].device == device.title


def test_it_ends_at_once_and_can_be_started_again(device):
    for _ in range(2):
        device.start(lambda reading: None)
        with pytest.raises(RuntimeError, match="started already"):
            device.start(lambda reading: None)
        begin = time.monotonic()
        device.stop()
        assert time.monotonic() - begin < 2.0
        assert device.health().state == "stopped"
        assert device.title not in {thread.name for thread in threading.enumerate()}


def test_a_receiver_that_fails_does_not_end_it(device, attempts):
    def fail(reading):
        raise ZeroDivisionError(reading.device)

    device.start(fail)
    until(lambda: len(attempts) > 3)
    assert device.health().counts["not received: error"] == 1


DRIVES = [name for name, cls in components("device").items() if issubclass(cls, DriveDevice)]


@pytest.mark.parametrize("name", DRIVES)
def test_commands_to_a_lost_device_return_at_once(name, tmp_path):
    drive = make(name, tmp_path)
    drive.start(lambda reading: None)
    until(lambda: drive.health().state == "lost")
    begin = time.monotonic()
    drive.drive(0.1, 0.0)
    drive.emergency_stop()
    drive.release()
    assert time.monotonic() - begin < 0.5
    drive.stop()
