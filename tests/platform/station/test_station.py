"""The station as a whole: what it does when a part of it fails."""

import threading

import pytest

from impslam.errors import ImpError
from impslam.platform.devices.base import Device, Reading, now
from impslam.platform.station.recorder import RecordingError
from impslam.platform.station.station import Station
from impslam.types import Climate

NO_DISK = 10**18  # bytes that no disk has free


class Silent(Device):
    """Never opens."""

    name = "silent"

    def _serve(self) -> None:
        self._stopping.wait()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "logs"


def station(folder, devices=(), floor=0):
    return Station(dict(devices), "imp", folder, (0.5, 1.0), floor)


def test_a_disk_without_room_is_told_and_the_robot_goes_on(folder):
    robot = station(folder, floor=NO_DISK)
    robot.begin(record=True, map_=False)
    status = robot.health().recording
    assert not status.active
    assert "is free on the disk" in status.error
    assert robot.events[-1].level == "error"
    robot.stop()


def test_it_begins_to_record_where_it_can(folder):
    robot = station(folder)
    robot.begin(record=True, map_=False)
    assert robot.health().recording.active
    robot.stop()
    assert [log.cut for log in robot.store.logs()] == [False]


def test_a_part_that_does_not_end_holds_up_no_other(folder, monkeypatch):
    robot = station(folder, {"lidar": Silent()})
    robot.recorder.start()

    def fail():
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(robot.helm, "stop", fail)
    with pytest.raises(ZeroDivisionError):
        robot.stop()
    assert not robot.health().recording.active


def test_a_folder_that_cannot_be_made_is_told_in_one_line(folder):
    folder.write_text("a file")
    robot = station(folder)
    with pytest.raises(RecordingError, match="cannot be written"):
        robot.recorder.start()
    with pytest.raises(ImpError, match="maps: cannot be written"):
        robot.save_map()
    assert robot.store.logs() == []


def test_readings_of_many_threads_leave_the_events_bounded_and_readable(folder):
    robot = station(folder)
    ended = threading.Event()

    def tell():
        while not ended.is_set():
            robot._announce("info", "news")
            robot._receive(Reading(Climate(now(), 20.0, 0.5), now(), "toy"))

    threads = [threading.Thread(target=tell) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in range(2000):
        assert len(list(robot.events)) <= 210  # 200, and what is just being added
    ended.set()
    for thread in threads:
        thread.join(5.0)
    assert len(robot.events) == 200
