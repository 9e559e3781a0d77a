import math
import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from tests.sources.bags import ROS1, ROS2, bag, header, image, imu, joints, odometry, scan, twist
from tests.sources.logs import assert_same, messages, read, write_mcap

import impslam
from impslam import columns
from impslam.errors import SourceError
from impslam.open_log import open_log
from impslam.sources import ros_rows
from impslam.sources.base import Source, recognise
from impslam.sources.recording import McapWriter
from impslam.sources.ros_topics import rival_note
from impslam.sources.rosbag import RosBag
from impslam.types import (
    Event,
    Image,
    LaserScan,
    Message,
    OdometryPose,
    TruePose,
    Velocity,
    WheelAngles,
)


@pytest.mark.parametrize("kind", ["ros1", "sqlite folder", "mcap folder", "sqlite", "mcap"])
def test_every_storage_reads_alike(tmp_path: Path, kind: str) -> None:
    store = ROS1 if kind == "ros1" else ROS2
    path = bag(
        tmp_path / f"log {kind.replace('sqlite', '3')}",
        ("/js", joints(store, ["wheel_right_joint", "wheel_left_joint"], [2.0, 1.0])),
        ("/scan", scan(store)),
        ("/odom", odometry(store)),
        ("/ground_truth", odometry(store, (0, 0, math.sin(0.5), math.cos(0.5)))),
        ("/cam", image(store, "rgb8; jpeg compressed bgr8")),
        store=store,
    )
    if kind in {"sqlite", "mcap"}:  # the file out of its folder, under a name that says nothing
        path = next(path.glob("log*")).rename(tmp_path / "file")
    found, source = read(path)
    assert [type(m) for m in found] == [WheelAngles, LaserScan, OdometryPose, TruePose, Image]
    assert {m.stamp for m in found} == {1.5}
    wheels, sweep, odom, truth, picture = found
    assert (wheels.left, wheels.right) == (1.0, 2.0)
    np.testing.assert_array_equal(sweep.angles, [-1.0, -0.5, 0.0])
    np.testing.assert_array_equal(sweep.ranges, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(sweep.time_offsets, [0.0, 0.25, 0.5])
    np.testing.assert_allclose(odom.pose, [1.0, 2.0, 0.0])
    np.testing.assert_allclose(truth.pose, [1.0, 2.0, 1.0])
    assert (picture.format, picture.data) == ("jpeg", b"\0\1\2\3")
    assert not source.problems.counts
    assert source.preset == "default"


def test_the_topic_with_most_messages_is_used_and_reported(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/b", scan(ROS2)), ("/a", scan(ROS2, 2.5)), ("/a", scan(ROS2, 3.5)))
    assert [m.stamp for m in read(path)[0]] == [2.5, 3.5]
    assert [m.stamp for m in read(path, topics={"scan": "/b"})[0]] == [1.5]
    assert read(path, topics={"scan": ""})[0] == []
    with RosBag(path=path) as source:
        shown = {s.name: (s.used, s.note) for s in source.streams()}
        assert source.total == 2
        said = "not read: scan is /a; set source.topics.scan=/b to use this one instead, or name it"
        assert shown == {"/a": (True, "scan"), "/b": (False, f"{said} in source.wanted")}


def test_equal_counts_are_settled_by_name(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/z", scan(ROS2)), ("/y", scan(ROS2, 2.5)))
    assert [m.stamp for m in read(path)[0]] == [2.5]


@pytest.mark.parametrize(("filtered", "expected"), [(2, "/scan"), (3, "/a")])
def test_the_topic_scan_is_preferred_unless_it_has_few_messages(
    tmp_path: Path, filtered: int, expected: str
) -> None:
    others = [("/a", scan(ROS2, 2.5 + k)) for k in range(filtered)]
    path = bag(tmp_path / "b", ("/scan", scan(ROS2)), *others)
    with RosBag(path=path) as source:
        assert [one.name for one in source.streams() if one.used] == [expected]


def test_odometry_may_be_assigned_to_the_truth(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/odom", odometry(ROS2)))
    assert [type(m) for m in read(path)[0]] == [OdometryPose]
    assert [type(m) for m in read(path, topics={"truth": "/odom"})[0]] == [TruePose]


def test_a_missing_topic_names_the_near_miss(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/scan", scan(ROS2)))
    with pytest.raises(SourceError, match=r"no topic '/scn' .* did you mean '/scan'"):
        read(path, topics={"scan": "/scn"})
    with pytest.raises(SourceError, match="none of this type"):
        read(path, topics={"imu": "/imu"})


def test_joints_by_name(tmp_path: Path) -> None:
    names = ["arm_left", "LeftWheel", "wheel_r", "rear_right_wheel", "right_wheel"]
    path = bag(tmp_path / "b", ("/js", joints(ROS2, names, [0.0, 1.0, 2.0, 3.0, 4.0])))
    (wheels,) = read(path)[0]
    assert (wheels.left, wheels.right) == (1.0, 3.0)
    (wheels,) = read(path, left_joint="arm_left", right_joint="wheel_r")[0]
    assert (wheels.left, wheels.right) == (0.0, 2.0)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["wheel_FL_joint", "wheel_RL_joint", "wheel_FR_joint", "wheel_RR_joint"], (0.0, 2.0)),
        (["rr_wheel", "rl_wheel", "fr_wheel", "fl_wheel", "arm_l"], (3.0, 2.0)),
        (["wheel_rf", "wheel_rr", "wheel_lf", "wheel_lr"], (2.0, 0.0)),
        (["wheel_r", "wheel_l"], (1.0, 0.0)),
        (["wheel_l", "left_arm", "right_wheel", "left_wheel"], (3.0, 2.0)),
    ],
)
def test_wheels_with_abbreviated_sides(
    tmp_path: Path, names: list[str], expected: tuple[float, float]
) -> None:
    values = [float(k) for k in range(len(names))]
    (wheels,) = read(bag(tmp_path / "b", ("/js", joints(ROS2, names, values))))[0]
    assert (wheels.left, wheels.right) == expected


def test_abbreviations_of_other_joints_are_no_wheels(tmp_path: Path) -> None:
    entry = ("/js", joints(ROS2, ["arm_l", "arm_r", "wheel_steering"], [1.0, 2.0, 3.0]))
    assert not read(bag(tmp_path / "b", entry))[0]


def test_joints_that_another_program_publishes_are_no_problem(tmp_path: Path) -> None:
    tilt = [("/js", joints(ROS2, ["laser_tilt_joint"], [0.1 * k], 1.0 + k)) for k in range(20)]
    wheels = [("/js", joints(ROS2, ["left", "right"], [1.0, 2.0], 0.5 + k)) for k in range(9)]
    found, source = read(bag(tmp_path / "b", *tilt[:9], *wheels, *tilt[9:]))
    assert len(found) == 9
    assert not source.problems.counts
    none, source = read(bag(tmp_path / "none", *tilt), topics={"wheels": "/js"})
    assert not none
    assert source.problems.counts == {"malformed wheels message": 20}


def test_joints_of_two_publishers_with_connections_of_their_own(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/JointState"
    with Writer1(tmp_path / "two.bag") as writer:
        arm, base = (
            writer.add_connection("/js", kind, typestore=ROS1, callerid=name)
            for name in ("/arm", "/base")
        )
        for k in range(9):
            tilt = joints(ROS1, ["laser_tilt_joint"], [0.1 * k], 1.0 + k)
            wheels = joints(ROS1, ["left", "right"], [1.0, 2.0], 1.5 + k)
            writer.write(arm, (100 + k) * 10**9, ROS1.serialize_ros1(tilt, kind))
            writer.write(base, (100 + k) * 10**9 + 1, ROS1.serialize_ros1(wheels, kind))
    found, source = read(tmp_path / "two.bag")
    assert len(found) == 9
    assert not source.problems.counts


def test_headers_without_stamp_fall_back_on_the_time_of_logging(tmp_path: Path) -> None:
    found, source = read(bag(tmp_path / "b", ("/s", scan(ROS2, 0.0)), ("/s", scan(ROS2, 0.0))))
    assert [m.stamp for m in found] == [100.0, 101.0]
    assert source.problems.counts == {"no stamp": 2}


@pytest.mark.parametrize("missing", [0, 2])
def test_headers_without_stamp_are_as_late_as_the_others(tmp_path: Path, missing: int) -> None:
    begin = 1_700_000_000.0
    stamps = [0.0 if k == missing else begin + k for k in range(5)]
    found, source = read(bag(tmp_path / "b", *(("/s", scan(ROS2, stamp)) for stamp in stamps)))
    np.testing.assert_allclose([m.stamp - begin for m in found], range(5), atol=1e-6)
    assert source.problems.counts == {"no stamp": 1}


@pytest.mark.parametrize("count", [2, 6])  # read one by one, and as a table
def test_quaternions_that_are_not_normalised_are_used_and_reported_once(
    tmp_path: Path, count: int
) -> None:
    wrong, right = (
        (0, 0, 2 * math.sin(0.5), 2 * math.cos(0.5)),
        (0, 0, math.sin(0.5), math.cos(0.5)),
    )
    turns = [right, *[wrong] * count, right]
    found, source = read(bag(tmp_path / "b", *(("/odom", odometry(ROS2, t)) for t in turns)))
    np.testing.assert_allclose([m.pose[2] for m in found], 1.0)
    assert source.problems.counts["quaternion not normalised"] == count
    assert "has the norm 2 instead of 1" in source.problems.examples["quaternion not normalised"]


def test_bad_messages_are_counted_and_dropped(tmp_path: Path) -> None:
    path = bag(
        tmp_path / "b",
        ("/js", joints(ROS2, ["left", "right"], [1.0])),
        ("/js", joints(ROS2, ["left", "right"], [1.0, math.nan])),
        ("/js", joints(ROS2, ["a", "b"], [1.0, 2.0])),
        ("/js", joints(ROS2, ["left", "right"], [1.0, 2.0])),
        ("/scan", scan(ROS2, start=math.inf)),
        ("/scan", scan(ROS2, n=0)),
        ("/scan", scan(ROS2, high=0.0)),
        ("/odom", odometry(ROS2, (0, 0, 0, 0))),
        ("/odom", odometry(ROS2, (0, 0, 0, math.nan))),
        ("/odom", odometry(ROS2, x=math.inf)),
        ("/cam", image(ROS2, "theora")),
    )
    found, source = read(path)
    assert [type(m) for m in found] == [WheelAngles, LaserScan]
    assert math.isnan(found[1].range_max)
    assert source.problems.counts == {
        "malformed wheels message": 2,
        "malformed scan message": 2,
        "malformed odometry message": 3,
        "malformed image message": 1,
    }


def test_a_bag_without_definitions_uses_the_standard_types(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/scan", scan(ROS2)))
    (data,) = path.glob("*.db3")
    with sqlite3.connect(data) as database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = ''")
    database.close()
    (sweep,) = read(path)[0]
    np.testing.assert_array_equal(sweep.ranges, [0.0, 1.0, 2.0])


@pytest.mark.parametrize("as_folder", [True, False])
def test_messages_in_a_write_ahead_log_are_read(tmp_path: Path, as_folder: bool) -> None:
    """A recorder that was killed leaves them there; the log itself is not touched."""
    path = bag(tmp_path / "b", *[("/scan", scan(ROS2))] * 5)
    (data,) = path.glob("*.db3")
    with closing(sqlite3.connect(data)) as database:
        rows = database.execute("SELECT * FROM messages").fetchall()
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("DELETE FROM messages")
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        marks = ",".join("?" * len(rows[0]))
        database.executemany(f"INSERT INTO messages VALUES ({marks})", rows)
        database.commit()
        killed = shutil.copytree(path, tmp_path / "killed")
    before = {file.name: file.read_bytes() for file in killed.iterdir()}
    found, _ = read(killed if as_folder else killed / data.name)
    assert len(found) == 5
    assert {file.name: file.read_bytes() for file in killed.iterdir()} == before


def test_a_file_truncated_by_power_loss_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    angles, times, ranges = 2.0**-10 * np.arange(5000.0), np.zeros(5000), np.zeros(5000)
    with McapWriter(path) as writer:
        for i in range(300):
            writer.write(LaserScan(float(i), angles, ranges, times))
    whole, _ = read(path)
    chunk = path.stat().st_size // 6  # of 1 MiB unpacked
    path.write_bytes(path.read_bytes()[: -2 * chunk])
    found, source = read(path)
    assert len(whole) == 300
    assert 100 < len(found) < 300
    assert [m.stamp for m in found] == [m.stamp for m in whole[: len(found)]]
    assert source.problems.counts == {"cut file": 1}
    assert source.preset == "imp"


def test_a_wanted_second_lidar_is_a_separate_stream(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", ("/b", scan(ROS2)), ("/a", scan(ROS2, 2.5)), ("/a", scan(ROS2, 3.5)))
    with RosBag(path=path, wanted=("/b",)) as source:
        shown = {s.name: (s.used, s.default, s.note) for s in source.streams()}
        assert shown == {"/a": (True, True, "scan"), "/b": (True, False, "scan")}
        assert source.defaults() == {LaserScan: "/a"}
        assert source.total == 3
        (batch,) = source.batches()
    assert {name: c.stamps.tolist() for name, c in batch.items()} == {"/a": [2.5, 3.5], "/b": [1.5]}


def test_a_point_cloud_is_told_what_reads_it() -> None:
    note = rival_note("/points", "sensor_msgs/msg/PointCloud2", {"/odom": "odometry"})
    assert note.startswith("not read: make a LaserScan of it with")


def test_a_run_without_scans_names_the_point_cloud(tmp_path: Path) -> None:
    fields = [ROS2.types["sensor_msgs/msg/PointField"](n, 4 * k, 7, 1) for k, n in enumerate("xyz")]
    head, data = scan(ROS2).header, np.zeros(12, np.uint8)
    cloud = ROS2.types["sensor_msgs/msg/PointCloud2"](head, 1, 1, fields, False, 12, 12, data, True)
    path = bag(tmp_path / "b", ("/points", cloud), ("/odom", odometry(ROS2)))
    with pytest.raises(
        SourceError, match=r"no usable scan; /points is a PointCloud2: make a Laser"
    ):
        impslam.run(path)


def test_a_bag_that_cannot_be_opened_is_an_error_with_advice(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:12])
    with pytest.raises(SourceError, match=r"a\.mcap: cannot be opened .*repair it with"):
        RosBag(path=path).__enter__()
    with pytest.raises(SourceError, match="not open"):
        next(RosBag(path=path).batches())


def without_profile(path: Path) -> Path:
    """Remove the profile from an MCAP file, as general MCAP libraries write it."""
    whole = path.read_bytes()
    size = int.from_bytes(whole[9:17], "little") - len("ros2")
    assert whole[17:25] == b"\4\0\0\0ros2"
    path.write_bytes(whole[:9] + size.to_bytes(8, "little") + bytes(4) + whole[25:])
    return path


def test_an_mcap_file_without_a_profile_is_read(tmp_path: Path) -> None:
    whole, _ = read(write_mcap(tmp_path / "a.mcap"))
    path = without_profile(tmp_path / "a.mcap")
    found, source = read(path)
    for one, other in zip(found, whole, strict=True):
        assert_same(one, other)
    assert not source.problems.counts
    path.write_bytes(path.read_bytes()[:-20])
    found, source = read(path)
    for one, other in zip(found, whole, strict=True):
        assert_same(one, other)
    assert source.problems.counts == {"cut file": 1}


def test_an_mcap_file_of_other_messages_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap")
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"ros2", b"ros1", 1))
    with pytest.raises(SourceError, match=r"not of ROS 2 \(its profile is ros1\); give the ROS 1"):
        RosBag(path=path).__enter__()
    folder = bag(tmp_path / "mcap", ("/scan", scan(ROS2)))
    file = without_profile(next(folder.glob("*.mcap")))
    file.write_bytes(file.read_bytes().replace(b"ros2msg", b"jsonsch"))
    with pytest.raises(SourceError, match="sensor_msgs/msg/LaserScan is defined in jsonsch"):
        RosBag(path=file).__enter__()


@pytest.mark.parametrize("count", [2, 12])
def test_an_increment_of_0_is_computed_and_impossible_angles_are_refused(
    tmp_path: Path, count: int
) -> None:
    def log(name: str, step: float, end: float) -> tuple[list[Message], Source]:
        scans = [scan(ROS2, 1.5 + k) for k in range(count)]
        for one in scans:
            one.angle_increment, one.angle_max = step, end
        return read(bag(tmp_path / name, *(("/scan", one) for one in scans)))

    found, source = log("zero", 0.0, 1.0)
    assert len(found) == count
    for one in found:
        np.testing.assert_array_equal(one.angles, [-1.0, 0.0, 1.0])  # type: ignore[attr-defined]
    assert source.problems.counts == {"no angle increment": count}
    for name, step, end, said in (
        ("no limits", 0.0, -1.0, "the angle between its 3 beams is 0"),
        ("degrees", 120.0, 239.0, "57 turns; write the angles of beams in rad, not in degrees"),
    ):
        found, source = log(name, step, end)
        assert not found
        assert source.problems.counts == {"malformed scan message": count}
        assert said in source.problems.examples["malformed scan message"]


@pytest.mark.parametrize("count", [2, 12])
@pytest.mark.parametrize("name", ["angle_increment", "time_increment"])
def test_an_increment_of_nan_is_unknown(tmp_path: Path, name: str, count: int) -> None:
    scans = [scan(ROS2, 1.5 + k) for k in range(count)]
    for one in scans:
        one.angle_increment, one.angle_max, one.time_increment = 1.0, 1.0, 0.0
        setattr(one, name, math.nan)
    found, source = read(bag(tmp_path / "nan", *(("/scan", one) for one in scans)))
    assert len(found) == count
    for one in found:
        np.testing.assert_array_equal(one.angles, [-1.0, 0.0, 1.0])  # type: ignore[attr-defined]
        np.testing.assert_array_equal(one.time_offsets, np.zeros(3))  # type: ignore[attr-defined]
    assert source.problems.counts == {f"no {name.replace('_', ' ')}": count}


def test_progress_runs_to_the_total(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap")
    with recognise(path)(path=path) as source:
        steps = [source.position for _ in columns.messages(source.batches(1))]
        assert source.total == source.position == len(messages())
    assert steps == list(range(1, len(messages()) + 1))


@pytest.mark.real
def test_real_turtlebot(data_folder: Path) -> None:
    found, source = read(data_folder / "turtlebot3" / "turtlebot3.bag")
    counts = Counter(type(m).__name__ for m in found)
    assert counts == {"LaserScan": 457, "WheelAngles": 2741, "OdometryPose": 2741, "Imu": 2253}
    assert not source.problems.counts
    assert {len(m.ranges) for m in found if isinstance(m, LaserScan)} == {360}
    wheels = [m for m in found if isinstance(m, WheelAngles)]
    assert wheels[0].left == pytest.approx(9.00880971)
    assert wheels[0].right == pytest.approx(-4.23206781)


def test_warnings_of_the_robot_are_problems_not_messages(tmp_path: Path) -> None:
    events = [("info", "ok"), ("warning", "slow\nindeed"), ("error", "lost"), ("error", "again")]
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.write(WheelAngles(1.0, 0.0, 0.0))
        for i, (level, text) in enumerate(events):
            writer.write(Event(2.0 + i, level, "urg", text))
        writer.write(WheelAngles(9.0, 0.0, 0.0))
    found, source = read(tmp_path / "a.mcap")
    assert [m.stamp for m in found] == [1.0, 9.0]
    assert source.problems.counts == {"warning on the robot": 1, "error on the robot": 2}
    assert list(source.problems.examples.values()) == [
        f"{tmp_path / 'a.mcap'}: urg: slow indeed",
        f"{tmp_path / 'a.mcap'}: urg: lost",
    ]


@pytest.mark.parametrize("store", [ROS1, ROS2], ids=["ros1", "ros2"])
def test_messages_read_as_tables_equal_those_read_one_by_one(
    tmp_path: Path, store: Any, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = [entry(store, i, rng) for i in range(400)]
    path = bag(tmp_path / "b", *entries, store=store)
    given = []
    real = ros_rows.Rows
    monkeypatch.setattr(
        ros_rows, "Rows", lambda datas, *about: given.append(len(datas)) or real(datas, *about)
    )
    found, source = read(path, wanted=("/odom2",))
    assert sum(given) > 300
    monkeypatch.setattr(ros_rows, "TABLES", {})
    expected, slow = read(path, wanted=("/odom2",))
    assert len(found) == len(expected) > 250
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)
    assert source.problems == slow.problems
    assert set(slow.problems.counts) >= {
        "malformed scan message",
        "malformed wheels message",
        "malformed odometry message",
        "malformed imu message",
        "no stamp",
    }


def entry(store: Any, i: int, rng: np.random.Generator) -> tuple[str, Any]:
    """Return a message of any type, now and then one that is odd or unsound."""
    stamp, odd = 0.1 * i, rng.integers(30)
    turn = tuple(rng.normal(size=4)) if odd else (0.0, 0.0, 0.0, 1e-9)
    scans = {
        0: scan(store, stamp, math.nan),
        1: scan(store, stamp, n=7),
        2: scan(store, stamp, -2.0),
    }
    scans |= {3: scan(store, stamp, n=0), 4: scan(store, 0.0)}
    names = ["left", "right"] if odd else ["a", "b"]
    return [
        ("/scan", scans.get(int(odd), scan(store, stamp, n=3))),
        ("/js", joints(store, names, [rng.normal(), math.nan if odd == 1 else 2.0], stamp)),
        ("/odom", odometry(store, turn, math.inf if odd == 1 else rng.normal())),
        ("/odom2", odometry(store, turn)),
        ("/imu", imu(store, stamp, float(odd == 0), math.nan if odd == 1 else rng.normal())),
    ][rng.integers(5)]


@pytest.mark.parametrize("high", [0.0, 0.1])
def test_limits_that_no_range_can_keep_are_unset(tmp_path: Path, high: float) -> None:
    """Drivers that do not know their lidar leave range_max at 0, and set range_min."""
    message = replace(scan(ROS2, high=high), range_min=0.15)
    found, _ = read(bag(tmp_path / "a.mcap", *[("/scan", message)] * 4))
    assert [m.range_min for m in found] == pytest.approx([math.nan] * 4, nan_ok=True)
    assert [m.range_max for m in found] == pytest.approx([math.nan] * 4, nan_ok=True)


def test_a_truncated_message_does_not_affect_the_others(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", *[("/scan", scan(ROS2, 0.5 * i, n=50)) for i in range(1, 30)])
    (file,) = path.glob("*.mcap")
    data = file.read_bytes()
    places = [k for k in range(len(data)) if data.startswith(b"\x32\0\0\0\0\0\0\0\0\0\x80\x3f", k)]
    spoilt = bytearray(data)
    spoilt[places[7]] = 200  # ranges, of 50 that are there
    file.write_bytes(spoilt)
    found, source = read(path)
    assert len(found) == 28
    assert source.problems.counts["malformed scan message"] == 1
    assert f"{path}:8: /scan: " in source.problems.examples["malformed scan message"]


def test_joints_without_wheels_are_not_read(tmp_path: Path) -> None:
    arm = joints(ROS2, ["shoulder", "elbow"], [1.0, 2.0])
    path = bag(tmp_path / "b", ("/arm", arm), ("/arm", arm), ("/scan", scan(ROS2)))
    found, source = read(path)
    assert [type(m) for m in found] == [LaserScan]
    assert not source.problems.counts
    with RosBag(path=path) as log:
        (shown,) = [stream for stream in log.streams() if stream.name == "/arm"]
    assert not shown.used
    assert "no wheels among the joints" in shown.note
    assert read(path, topics={"wheels": "/arm"})[1].problems.counts == {
        "malformed wheels message": 2
    }
    found, _ = read(path, left_joint="shoulder", right_joint="elbow")
    assert [type(m) for m in found] == [WheelAngles, WheelAngles, LaserScan]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            ["wheel_1", "wheel_2"],
            "no wheels among the joints wheel_1, wheel_2; name them with --set",
        ),
        (["left_wheel", "right_wheel"], "velocities, but no positions"),
        (
            ["left_wheel_joint", "right_wheel_joint"],
            "/js are not read: for them set odometry.kind=encoders",
        ),
        (["shoulder", "elbow"], ""),
    ],
)
def test_wheels_that_are_not_read_are_named(tmp_path: Path, names: list[str], said: str) -> None:
    values = [] if "no positions" in said else [1.0, 2.0]
    path = bag(tmp_path / "b", *[("/js", joints(ROS2, names, values)), ("/scan", scan(ROS2))] * 2)
    config, source = open_log(path)
    assert config.odometry == {"kind": "lidar_only"}
    assert said in source.problems.examples.get("unknown odometry", "")
    assert bool(said) == bool(source.problems.counts)
    _, source = open_log(path, settings=["odometry.kind=lidar_only"])
    assert not source.problems.counts, "the user has chosen"


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped"])
def test_poses_are_odometry_if_they_are_named(tmp_path: Path, kind: str) -> None:
    """As of a scan matcher or a filter; otherwise they may be poses in a map."""
    new = lambda name, *values: ROS2.types[f"geometry_msgs/msg/{name}"](*values)  # noqa: E731
    pose = new("Pose", new("Point", 1.0, 2.0, 0.0), new("Quaternion", 0.0, 0.0, 0.6, 0.8))
    known = pose if kind == "PoseStamped" else new("PoseWithCovariance", pose, np.zeros(36))
    entries = [("/pose", new(kind, header(ROS2, k), known)) for k in (1.0, 2.0)]
    goal = ("/goal_pose", new("PoseStamped", header(ROS2), pose))
    path = bag(tmp_path / "bag", *entries, goal, ("/scan", scan(ROS2)), ("/scan", scan(ROS2)))
    _, source = open_log(path)
    assert source.problems.examples["unknown odometry"].endswith(
        f"{path}: /pose is not read: if these poses are odometry, not poses in a map, use them with "
        "--topic odometry=/pose; to compare the path with them, --topic truth=/pose"
    )
    poses = [m for m in read(path, topics={"odometry": "/pose"})[0] if isinstance(m, OdometryPose)]
    assert [m.stamp for m in poses] == [1.0, 2.0]
    np.testing.assert_allclose(poses[0].pose, [1.0, 2.0, 2 * math.asin(0.6)])
    found, _ = read(path, topics={"truth": "/pose"})
    truth = [m for m in found if isinstance(m, TruePose)]
    assert [m.stamp for m in truth] == [1.0, 2.0]
    np.testing.assert_allclose(truth[0].pose, poses[0].pose)
    _, source = open_log(path, settings=["source.topics.truth=/pose"])
    assert "/pose is" not in source.problems.examples.get("unknown odometry", "")


def test_measured_velocities_are_read_if_they_are_named(tmp_path: Path) -> None:
    """Commanded ones have the same type."""
    messages = [("/cmd_vel", twist(ROS2, 1.0, 3.0, 0.0)), ("/twist", twist(ROS2, 1.5, 0.5, 0.25))]
    path = bag(tmp_path / "b", *messages, ("/scan", scan(ROS2)))
    config, source = open_log(path)
    assert config.odometry == {"kind": "lidar_only"}
    (said,) = source.problems.examples.values()
    assert said.endswith("not commanded, use them with --topic velocity=/twist")
    assert "cmd_vel" not in said
    config, source = open_log(path, settings=["source.topics.velocity=/twist"])
    assert config.odometry == {"kind": "velocity"}
    assert not source.problems.counts
    only, _ = read(path, topics={"velocity": "/twist"})[0]
    assert isinstance(only, Velocity)
    assert (only.stamp, only.speed, only.turn_rate) == (1.5, 0.5, 0.25)


def test_the_twist_of_odometry_can_be_read_instead_of_its_pose(tmp_path: Path) -> None:
    message = odometry(ROS2)
    message.twist.twist.linear.x, message.twist.twist.angular.z = 0.5, -0.25
    path = bag(tmp_path / "b", *[("/odom", message)] * 5, ("/scan", scan(ROS2)))
    *found, _ = read(path, topics={"velocity": "/odom"})[0]
    assert [(type(m), m.speed, m.turn_rate) for m in found] == [(Velocity, 0.5, -0.25)] * 5


@pytest.mark.parametrize("plugin", ["sqlite", "mcap"])
def test_the_metadata_of_a_bag_stands_for_its_folder(tmp_path: Path, plugin: str) -> None:
    path = bag(tmp_path / plugin, ("/scan", scan(ROS2)))
    assert recognise(path / "metadata.yaml") is RosBag
    (found,), source = read(path / "metadata.yaml")
    assert_same(found, read(path)[0][0])
    assert source.path == path


def test_metadata_of_another_program_are_no_bag(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("title: notes\n")
    bag(tmp_path / "mcap", ("/scan", scan(ROS2)))
    with pytest.raises(SourceError, match=r"metadata\.yaml: no known log format"):
        recognise(tmp_path / "metadata.yaml")
