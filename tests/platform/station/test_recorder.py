"""The recorder: everything is in the log, nothing waits for the disk, and every end is notified."""

import errno
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from benchmarks.kill9 import MAX_LOSS, FullRate, kill_once
from rosbags.rosbag2.storage_mcap import McapReader
from tests.sources.logs import read

from impslam.platform.devices.base import Reading, event, now
from impslam.platform.station import recorder as recorder_module
from impslam.platform.station import recorder_thread
from impslam.platform.station.recorder import (
    LogRecorder,
    RecordingError,
    RecordingStatus,
    file_name,
)
from impslam.platform.station.recorder_queue import ReadingQueue
from impslam.platform.station.topics import TopicNames
from impslam.sources import live_recording
from impslam.sources.base import Stream, recognise
from impslam.types import (
    Climate,
    DeviceTime,
    Event,
    Image,
    Imu,
    LaserScan,
    Steering,
    WheelAngles,
)

PATIENCE = 20.0  # s; a loaded machine is no failure


@pytest.fixture
def recorder(tmp_path: Path) -> LogRecorder:
    """Notifies into its own log, as on the robot."""

    def notify(level: str, text: str) -> None:
        made.put(event("recorder", level, text))

    made = LogRecorder(tmp_path / "logs", "imp", 0, notify)
    return made


@pytest.fixture
def notices() -> list[tuple[str, str]]:
    return []


def unheard(_level: str, _text: str) -> None:
    """Ignore a notice."""


def notifier(notices: list[tuple[str, str]]) -> Callable[[str, str], None]:
    return lambda level, text: notices.append((level, text))


def until(true: Callable[[], object]) -> None:
    limit = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < limit
        time.sleep(0.01)


def ended(recorder: LogRecorder) -> RecordingStatus:
    until(lambda: not recorder.status().active)
    return recorder.status()


def wheels(number: int, moment: float | None = None, device: str = "autopilot") -> Reading:
    moment = now() if moment is None else moment
    return Reading(WheelAngles(moment, number, -number), moment, device)


def scan(moment: float, device: str = "urg", uneven: bool = False) -> Reading:
    angles = np.array([0.0, 0.1, 0.3 if uneven else 0.2])
    bright = np.array([1.0, 2.0, 3.0])
    message = LaserScan(moment, angles, np.ones(3), np.zeros(3), 0.0, 5.0, bright)
    return Reading(message, moment, device)


def image(size: int) -> Reading:
    return Reading(Image(1.0, "jpeg", bytes(size)), 1.0, "camera")


def topics(path: Path) -> dict[str, int]:
    reader = McapReader(path)
    reader.open()
    found = {connection.topic: connection.msgcount for connection in reader.connections}
    reader.close()
    return found


def test_all_readings_are_in_the_log(recorder: LogRecorder) -> None:
    path = recorder.start()
    begin, robot = now(), FullRate()
    for number in range(1, 201):
        for reading in robot.tick(number, begin + 0.01 * number):
            recorder.put(reading)
    assert recorder.stop() == path
    status = recorder.status()
    assert (status.active, status.dropped, status.error, status.waiting) == (False, {}, "", 0)
    assert status.size == path.stat().st_size
    fast = ["/joint_states", "/imu", "/imu/acceleration_2", "/imu/magnetic_field", "/temperature"]
    fast += ["/encoders/voltage", "/humidity", "/clock/autopilot"]
    want = dict.fromkeys(fast, 200) | {"/scan": 20, "/camera/image/compressed": 10}
    assert topics(path) == want | {"/impslam/preset": 1, "/rosout": 1}
    kinds = ["WheelAngles", "EncoderVoltages", "Imu", "Acceleration", "MagneticField", "Climate"]
    written = dict.fromkeys([*kinds, "DeviceTime"], 200) | {"LaserScan": 20, "Image": 10}
    assert status.written == written | {"Event": 1}
    found, source = read(path)
    assert source.preset == "imp"
    assert not source.problems.counts
    assert [m.left for m in found if isinstance(m, WheelAngles)] == [
        0.1 * number for number in range(1, 201)
    ]
    used = {stream.name: stream.note for stream in source_streams(path) if stream.used}
    assert used == {
        "/scan": "scan",
        "/joint_states": "wheels",
        "/imu": "imu",
        "/camera/image/compressed": "image",
        "/impslam/preset": "preset",
    }


def source_streams(path: Path) -> list[Stream]:
    with recognise(path)(path=path) as source:
        return source.streams()


def test_log_times_are_arrivals_and_header_stamps_the_readings(recorder: LogRecorder) -> None:
    path, begin = recorder.start(), now()
    late = [Reading(WheelAngles(begin + t, t, t), begin + t + 0.05, "a") for t in (0.1, 0.3, 0.2)]
    for reading in late:  # threads may overtake one another on the way to the queue
        recorder.put(reading)
    recorder.stop()
    found, _ = read(path)
    assert [m.stamp for m in found] == [begin + t for t in (0.1, 0.2, 0.3)]
    reader = McapReader(path)
    reader.open()
    wanted = [c for c in reader.connections if c.topic == "/joint_states"]
    times = [stamp * 1e-9 for _, stamp, _ in reader.messages(wanted)]
    reader.close()
    np.testing.assert_allclose(times, [begin + t + 0.05 for t in (0.1, 0.2, 0.3)], atol=1e-6)


def test_what_was_put_is_on_the_disk_within_a_second(recorder: LogRecorder) -> None:
    path = recorder.start()
    recorder.put(wheels(1))
    put = time.monotonic()
    while not any(isinstance(m, WheelAngles) for m in read(path)[0]):
        assert time.monotonic() - put < PATIENCE
        time.sleep(0.02)
    assert recorder.status().active
    assert recorder_thread.SYNC_INTERVAL < 0.5
    recorder.stop()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_kill_costs_at_most_a_second(seed: int) -> None:
    assert kill_once(seed) <= MAX_LOSS


def test_names(recorder: LogRecorder) -> None:
    first = recorder.start("Küche 2/../x")
    recorder.stop()
    assert first.parent.name == "logs"
    assert first.name.endswith("-Kuche-2-.-x.mcap")
    again = [recorder.start("same"), recorder.stop(), recorder.start("same"), recorder.stop()]
    assert len(set(again)) == 2  # within one second
    assert all(path is not None and path.is_file() for path in again)
    assert [p.name for p in first.parent.iterdir() if not p.name.endswith(".mcap")] == []


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("", ""),
        ("lab.mcap", "lab"),
        ("../../etc/passwd", "etc-passwd"),
        ("...", ""),
        ("\0\n", ""),
        ("x" * 500, "x" * 60),
        ("実験", ""),
    ],
)
def test_names_are_made_safe(label: str, name: str) -> None:
    assert file_name(label) == name


def test_one_log_at_a_time_and_stopping_twice_is_no_error(recorder: LogRecorder) -> None:
    assert recorder.stop() is None
    assert recorder.status().path is None
    path = recorder.start()
    with pytest.raises(RecordingError, match="is being recorded; stop it first"):
        recorder.start()
    assert recorder.stop() == path
    assert recorder.stop() is None
    recorder.put(wheels(1))  # nothing happens
    assert "WheelAngles" not in recorder.status().written


def test_a_bad_message_is_dropped_and_notified_once(
    tmp_path: Path, notices: list[tuple[str, str]]
) -> None:
    recorder = LogRecorder(tmp_path, "imp", 0, notifier(notices))
    path, moment = recorder.start(), now()
    for _ in range(3):
        recorder.put(scan(moment, uneven=True))
    recorder.put(Reading(Steering(moment, 1.0, 0.0), moment, "car"))
    recorder.put(Reading(WheelAngles(float("nan"), 1.0, 1.0), moment, "autopilot"))
    recorder.put(Reading(Climate(moment, 20.0, "wet"), moment, "autopilot"))  # type: ignore[arg-type]
    recorder.put(Reading(WheelAngles(moment, 1.0, 1.0), float("nan"), "autopilot"))
    recorder.put(wheels(1, moment))
    recorder.stop()
    status = recorder.status()
    assert status.dropped == {"LaserScan": 3, "Steering": 1, "WheelAngles": 2, "Climate": 1}
    assert status.written == {"WheelAngles": 1}
    assert [text for level, text in notices if level == "warning" and "LaserScan" in text] == [
        "urg: LaserScan cannot be recorded: angles are not equally spaced, as "
        "sensor_msgs/LaserScan requires"
    ]
    assert topics(path) == {"/impslam/preset": 1, "/joint_states": 1}


def test_a_second_lidar_has_a_topic_of_its_own(recorder: LogRecorder) -> None:
    path, moment = recorder.start(), now()
    for device in ("urg", "urg", "rear lidar", "urg"):
        recorder.put(scan(moment, device))
    for device in ("urg", "9 dof"):
        recorder.put(Reading(DeviceTime(moment, device, 3.25), moment, device))
        recorder.put(Reading(Event(moment, "error", device, "lost"), moment, device))
    recorder.stop()
    found = topics(path)
    assert (found["/scan"], found["/scan/rear_lidar"]) == (3, 1)
    assert (found["/clock/urg"], found["/clock/_9_dof"], found["/rosout"]) == (1, 1, 3)
    streams = {stream.name: stream for stream in source_streams(path)}
    assert {t for t, s in streams.items() if s.used} == {"/scan", "/impslam/preset"}
    assert streams["/scan/rear_lidar"].note == (
        "not read: scan is /scan; set source.topics.scan=/scan/rear_lidar to use this one "
        "instead, or name it in source.wanted"
    )
    assert streams["/clock/urg"].note == "kept: a device's clock"
    _, source = read(path)
    assert source.problems.counts["error on the robot"] == 2  # of the three events
    assert source.problems.examples["error on the robot"] == f"{path}: urg: lost"


@pytest.mark.parametrize("order", [("front", "rear"), ("rear", "front")])
@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ((), None),  # whoever is first
        (("/scan/front", "/scan/rear"), {"front": "/scan/front", "rear": "/scan/rear"}),
        (("/scan", "/scan/rear"), {"front": "/scan", "rear": "/scan/rear"}),
    ],
)
def test_a_topic_that_the_config_wants_is_that_of_its_device(
    order: tuple[str, str], wanted: tuple[str, ...], expected: dict[str, str] | None
) -> None:
    names = TopicNames(wanted)
    for _ in range(2):
        found = {device: names.topic(scan(now(), device).message, device) for device in order}
        assert found == (expected or {order[0]: "/scan", order[1]: f"/scan/{order[1]}"})
    assert names.topic(Event(now(), "error", "rear", "lost"), "rear") == "/rosout"


def test_a_slow_disk_blocks_nobody_and_pictures_are_dropped_first(
    tmp_path: Path, notices: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    recorder = LogRecorder(tmp_path, "imp", 0, notifier(notices))
    monkeypatch.setattr(
        recorder_thread, "ReadingQueue", lambda: ReadingQueue(count=100, size=100_000)
    )
    path = recorder.start()
    monkeypatch.setattr(live_recording, "_sync_data", lambda _: free.wait(PATIENCE))
    time.sleep(2.0 * recorder_thread.SYNC_INTERVAL)  # by now it waits for the disk
    longest = 0.0
    for number in range(90):
        for reading in (wheels(number), image(100), Reading(Imu(1.0, *np.ones((2, 3))), 1.0, "a")):
            begin = time.monotonic()
            recorder.put(reading)
            longest = max(longest, time.monotonic() - begin)
    assert longest < 1.0
    dropped = recorder.status().dropped
    assert dropped["Image"] > dropped["Imu"] > dropped["WheelAngles"] > 0
    free.set()
    until(lambda: any("dropped so far" in text for _, text in notices))
    recorder.stop()
    status = recorder.status()
    assert status.dropped == dropped
    for kind in ("WheelAngles", "Imu", "Image"):
        assert status.written[kind] + status.dropped[kind] == 90
    assert any("too slow" in text for level, text in notices if level == "warning")
    assert topics(path)["/joint_states"] == status.written["WheelAngles"]


def test_the_queue_bridges_ten_seconds_at_full_rate() -> None:
    queue, robot, count = ReadingQueue(), FullRate(), 0
    for number in range(1000):
        for reading in robot.tick(number, 100.0 + 0.01 * number):
            queue.put(reading)
            count += 1
    assert not queue.dropped()
    assert len(queue.take()) == count
    assert queue.take() == []


def test_the_queue_drops_by_type_and_counts() -> None:
    queue = ReadingQueue(count=8, size=10**6)
    others = Reading(Imu(1.0, np.zeros(3), np.zeros(3)), 1.0, "a")
    for reading in [image(1)] * 6 + [others] * 6 + [wheels(1, 1.0), scan(1.0)] * 3:
        queue.put(reading)
    kinds = [type(r.message).__name__ for r in queue.take()]
    assert [kinds.count(k) for k in ("Image", "Imu", "WheelAngles", "LaserScan")] == [4, 2, 1, 1]
    assert queue.dropped() == {"Image": 2, "Imu": 4, "WheelAngles": 2, "LaserScan": 2}
    for reading in (image(400_000), image(200_000)):  # the second is beyond half the bytes
        queue.put(reading)
    assert len(queue.take()) == 1
    queue.close()
    queue.put(others)
    assert len(queue) == 0
    assert queue.dropped()["Imu"] == 4


def test_a_disk_that_hangs_does_not_block_the_status(
    recorder: LogRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "SAMPLE_INTERVAL", 0.01)
    known, hanging = recorder.status().free, threading.Event()
    assert known > 0
    usage = shutil.disk_usage("/")

    def hang(_: object) -> object:
        hanging.wait(PATIENCE)
        return usage

    monkeypatch.setattr(recorder_module.shutil, "disk_usage", hang)
    time.sleep(0.02)
    begin, threads = time.monotonic(), threading.active_count()
    for _ in range(20):
        assert recorder.status().free == known
        time.sleep(0.002)
    assert time.monotonic() - begin < 1.0
    assert threading.active_count() <= threads + 1
    hanging.set()
    until(lambda: threading.active_count() <= threads)


def free_space(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    usage = shutil.disk_usage("/")._replace(free=free)
    monkeypatch.setattr(recorder_module.shutil, "disk_usage", lambda _: usage)


def test_the_disk_is_never_filled_beyond_its_reserve(
    tmp_path: Path, notices: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = LogRecorder(tmp_path, "imp", 10**9, notifier(notices))
    free_space(monkeypatch, 10**9 + 5)
    assert recorder.status().free == 5
    path = recorder.start()
    recorder.put(wheels(1))
    free_space(monkeypatch, 10**9 - 1)
    status = ended(recorder)
    assert "the disk is full up to its reserve" in status.error
    assert any(level == "error" and str(path) in text for level, text in notices)
    assert not read(path)[1].problems.counts  # closed like any other
    with pytest.raises(RecordingError, match="less than the reserve of 1000 MB is free"):
        recorder.start()
    assert "reserve" in recorder.status().error
    until(lambda: recorder.status().free == 0)
    free_space(monkeypatch, 10**10)
    recorder.start()
    assert recorder.status().error == ""
    recorder.stop()


@pytest.mark.parametrize(
    ("code", "label"),
    [
        (errno.ENOSPC, "No space left on device); delete logs"),
        (errno.EIO, "Input/output error); save its logs and replace the disk"),
        (errno.EROFS, "Read-only file system); check the file system"),
        (errno.EBADF, "Bad file descriptor); check the disk"),
    ],
)
def test_a_failing_disk_ends_the_recording_and_nothing_else(
    recorder: LogRecorder, monkeypatch: pytest.MonkeyPatch, code: int, label: str
) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(code, os.strerror(code))

    path = recorder.start()
    recorder.put(wheels(7))
    monkeypatch.setattr(live_recording, "_sync_data", fail)
    status = ended(recorder)
    assert label in status.error
    assert "\n" not in status.error
    assert status.written.get("WheelAngles", 0) + status.dropped.get("WheelAngles", 0) == 1
    recorder.put(wheels(8))
    assert recorder.stop() is None
    assert [m.left for m in read(path)[0] if isinstance(m, WheelAngles)] == [7.0]
    monkeypatch.undo()
    recorder.start()
    assert recorder.status().error == ""
    recorder.stop()


def test_two_recorders_can_start_in_the_same_second(tmp_path: Path, monkeypatch) -> None:
    """All find the name free; the first to create it gets it, and the others take the next."""
    monkeypatch.setattr(time, "strftime", lambda _: "20260101-000000")
    recorders = [LogRecorder(tmp_path, "imp", 0, lambda *_: None) for _ in range(8)]
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda recorder: recorder.start(), recorders))
    numbers = ["", *(f"-{number}" for number in range(2, 9))]
    assert {path.name for path in paths} == {f"20260101-000000{n}.mcap" for n in numbers}
    assert all(ended_well(recorder) for recorder in recorders)


@pytest.mark.parametrize("how", ["file deleted", "folder deleted", "file moved", "file cut"])
def test_a_log_that_vanishes_ends_the_recording(
    recorder: LogRecorder, tmp_path: Path, how: str
) -> None:
    path = recorder.start()
    if how == "file deleted":
        path.unlink()
    elif how == "folder deleted":
        shutil.rmtree(path.parent)
    elif how == "file cut":
        os.truncate(path, 100)
    else:
        path.rename(tmp_path / "elsewhere.mcap")
    assert "was moved, deleted or cut while it was written" in ended(recorder).error
    assert recorder.start().is_file()  # the folder is created again
    assert ended_well(recorder)


def ended_well(recorder: LogRecorder) -> bool:
    recorder.stop()
    return recorder.status().error == ""


def test_an_impossible_folder_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    recorder = LogRecorder(tmp_path / "file" / "logs", "imp", 0, unheard)
    with pytest.raises(RecordingError, match="cannot be written") as raised:
        recorder.start()
    assert "\n" not in str(raised.value)
    assert recorder.status().error == str(raised.value)
    assert not recorder.status().active


def test_a_bug_of_the_recorder_is_notified_and_does_not_spread(
    recorder: LogRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: object) -> None:
        raise RuntimeError("what a surprise")

    path = recorder.start()
    recorder.put(wheels(1))
    until(lambda: recorder.status().written.get("WheelAngles"))
    monkeypatch.setattr(live_recording.LiveMcapWriter, "sync", fail)
    assert "what a surprise; please report it" in ended(recorder).error
    assert any(isinstance(m, WheelAngles) for m in read(path)[0])


LIMITED = """
import resource, signal, sys, time
from pathlib import Path
from tests.platform.station.test_recorder import ended, image, unheard
from impslam.platform.station.recorder import LogRecorder

recorder = LogRecorder(Path(sys.argv[1]), "imp", 0, unheard)
path = recorder.start()
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
import numpy as np
from impslam.platform.devices.base import Reading
from impslam.types import Image, WheelAngles
for i in range(20):
    recorder.put(Reading(WheelAngles(1.0 + i, i, i), 1.0 + i, "autopilot"))
    noise = np.random.default_rng(i).bytes(10_000)
    recorder.put(Reading(Image(1.0 + i, "jpeg", noise), 1.0 + i, "camera"))
    time.sleep(0.1)
print(ended(recorder).error)
print(path)
"""


def test_a_write_that_fails_halfway_leaves_what_was_written_before(tmp_path: Path) -> None:
    """The kernel refuses further writes in the middle of a chunk."""
    command = [sys.executable, "-c", LIMITED, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    error, path = done.stdout.splitlines()
    assert "File too large" in error
    found, source = read(Path(path))
    kept = [m.left for m in found if isinstance(m, WheelAngles)]
    assert kept == list(range(len(kept)))
    assert 5 < len(kept) <= 20
    assert source.problems.counts == {"cut file": 1}
