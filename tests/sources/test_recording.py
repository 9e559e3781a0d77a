import math
import tracemalloc
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from tests.sources.logs import assert_same, messages, read, write_mcap

from impslam import columns
from impslam.config import load
from impslam.config_from_log import choices
from impslam.errors import MessageError, SourceError
from impslam.sources.base import recognise
from impslam.sources.recording import McapWriter
from impslam.sources.ros_build import nanoseconds as nanoseconds_of
from impslam.sources.ros_build import topic_name
from impslam.sources.ros_messages import read_odometry, seconds
from impslam.sources.ros_writers import pose
from impslam.types import (
    Acceleration,
    Climate,
    DeviceTime,
    EncoderVoltages,
    Event,
    LaserScan,
    MagneticField,
    Message,
    OdometryPose,
    SatelliteFix,
    Steering,
    TruePose,
    Velocity,
    WheelAngles,
)


def record(path: Path, *what: Message, preset: str = "imp") -> Path:
    with McapWriter(path, preset) as writer:
        for message in what:
            writer.write(message)
    return path


def test_messages_survive_a_round_trip_in_order(tmp_path: Path) -> None:
    found, source = read(write_mcap(tmp_path / "a.mcap"))
    for have, want in zip(found, messages(), strict=True):
        if isinstance(want, OdometryPose | TruePose):
            np.testing.assert_allclose(have.pose, want.pose, rtol=1e-15, atol=1e-15)
        else:
            assert_same(have, want)
    assert not source.problems.counts


def test_the_same_messages_give_the_same_bytes_under_any_name(tmp_path: Path) -> None:
    a, b = write_mcap(tmp_path / "a.mcap"), write_mcap(tmp_path / "other name.mcap")
    assert a.read_bytes() == b.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "other name.mcap"]


def test_the_preset_is_written_first_and_read_back(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", WheelAngles(5.0, 1.0, 2.0), preset="some-robot")
    with Reader(path) as reader:
        assert next(reader.messages())[0].topic == "/impslam/preset"
    assert read(path)[1].preset == "some-robot"
    assert read(record(tmp_path / "b.mcap", preset="some-robot"))[1].preset == "some-robot"


def test_the_order_of_writing_survives_backward_stamps(tmp_path: Path) -> None:
    stamps = [5.0, 4.0, 4.5, 6.0]
    path = record(tmp_path / "a.mcap", *(WheelAngles(s, 0.0, 0.0) for s in stamps))
    found, source = read(path)
    assert [m.stamp for m in found] == stamps
    assert source.problems.counts == {"backward stamp": 1}


def test_single_precision_of_angles_costs_less_than_a_microradian(tmp_path: Path) -> None:
    angles = (np.arange(44, 726) - 384) * 2 * math.pi / 1024
    scan = LaserScan(1.0, angles, np.ones(682), np.arange(682) * 0.1 / 1024)
    (back,) = read(record(tmp_path / "a.mcap", scan))[0]
    np.testing.assert_allclose(back.angles, angles, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.time_offsets, scan.time_offsets, rtol=0, atol=1e-8)
    assert math.isnan(back.range_min)


def test_memory_stays_flat_in_writing_and_reading(tmp_path: Path, rng: np.random.Generator) -> None:
    peaks = [_peaks(tmp_path / f"{n}.mcap", n, rng.random(2000)) for n in (500, 1500)]  # 4, 12 MB
    assert (np.array(peaks[1]) < 1.2 * np.array(peaks[0])).all()


def _peaks(path: Path, n: int, ranges: np.ndarray) -> list[int]:
    peaks = []
    angles, times = 2.0**-10 * np.arange(len(ranges)), np.zeros(len(ranges))
    tracemalloc.start()
    with McapWriter(path) as writer:
        for i in range(n):
            writer.write(LaserScan(0.1 * i, angles, ranges, times))
    peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.reset_peak()
    with recognise(path)(path=path) as source:
        assert sum(1 for _ in columns.messages(source.batches(64))) == n
    peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
    return peaks


def test_a_simulation_may_begin_at_zero(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.write(WheelAngles(0.0, 1.0, 2.0), log_stamp=0.1)
    found, source = read(tmp_path / "a.mcap")
    assert [m.stamp for m in found] == [0.0]
    assert not source.problems.counts


@pytest.mark.parametrize(
    "bad",
    [
        WheelAngles(-1.0, 0.0, 0.0),
        WheelAngles(math.nan, 0.0, 0.0),
        WheelAngles(2.0**31, 0.0, 0.0),
        LaserScan(1.0, np.empty(0), np.empty(0), np.empty(0)),
        LaserScan(1.0, np.array([0.0, 0.1, 0.3]), np.ones(3), np.zeros(3)),
        LaserScan(1.0, np.arange(3.0), np.ones(3), np.array([0.0, 0.1, 0.3])),
    ],
)
def test_messages_that_ros_cannot_represent_are_rejected(tmp_path: Path, bad: Message) -> None:
    with McapWriter(tmp_path / "a.mcap") as writer, pytest.raises(MessageError):
        writer.write(bad)


def test_an_error_leaves_no_file(tmp_path: Path) -> None:
    good, bad = WheelAngles(1.0, 0.0, 0.0), WheelAngles(math.nan, 0.0, 0.0)
    with pytest.raises(MessageError):
        record(tmp_path / "a.mcap", good, bad)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SourceError, match="cannot be written"):
        McapWriter(tmp_path / "no" / "a.mcap").__enter__()


@given(st.integers(0, 2 * 10**18))
def test_stamps_survive_to_the_last_bit(nanoseconds: int) -> None:
    stamp = seconds(nanoseconds)
    assert seconds(nanoseconds_of(stamp)) == stamp


@given(st.floats(-math.pi, math.pi), st.floats(-1e6, 1e6))
def test_poses_survive(theta: float, x: float) -> None:
    back = read_odometry(pose(OdometryPose(1.0, np.array([x, -x, theta]))), 1.0)
    assert back.pose[0] == x
    error = math.remainder(back.pose[2] - theta, 2 * math.pi)
    assert abs(error) < 1e-15


def one_of_each() -> list[tuple[Message, dict[str, dict[str, object]]]]:
    """Messages of the robot, and what other tools must find of them: values by topic and field."""
    force, field = np.array([0.5, -0.25, 9.75]), np.array([2e-5, 0.0, -4e-5])
    return [
        (
            EncoderVoltages(1.5, 0.25, 4.5),
            {"/encoders/voltage": {"vector.x": 0.25, "vector.y": 4.5}},
        ),
        (
            Acceleration(1.5, force),
            {"/imu/acceleration_2": {"accel.linear.x": 0.5, "accel.linear.z": 9.75}},
        ),
        (MagneticField(1.5, field), {"/imu/magnetic_field": {"magnetic_field.z": -4e-5}}),
        (
            Climate(1.5, 21.5, 0.375),
            {"/temperature": {"temperature": 21.5}, "/humidity": {"relative_humidity": 0.375}},
        ),
        (
            DeviceTime(1.5, "Front lidar", 7.25),
            {
                "/clock/Front_lidar": {
                    "time_ref.sec": 7,
                    "time_ref.nanosec": 250_000_000,
                    "source": "Front lidar",
                }
            },
        ),
        (
            Event(1.5, "warning", "urg", "too\nhot"),
            {"/rosout": {"level": 30, "name": "urg", "msg": "too\nhot", "stamp.sec": 1}},
        ),
        (
            Velocity(1.5, 0.5, -0.25),
            {"/cmd_vel": {"twist.linear.x": 0.5, "twist.angular.z": -0.25}},
        ),
    ]


@pytest.mark.parametrize(("message", "topics"), one_of_each())
def test_events_of_the_robot_are_readable_by_other_tools(
    tmp_path: Path, message: Message, topics: dict[str, dict[str, object]]
) -> None:
    path = record(tmp_path / "a.mcap", message)
    with Reader(path) as reader:
        store = get_typestore(Stores.ROS2_HUMBLE)  # its own definitions, not ours
        found = {
            c.topic: store.deserialize_cdr(data, c.msgtype) for c, _, data in reader.messages()
        }
    assert set(found) == set(topics) | {"/impslam/preset"}
    for topic, fields in topics.items():
        for name, value in fields.items():
            assert attrgetter(name)(found[topic]) == value
        stamp = found[topic].stamp if topic == "/rosout" else found[topic].header.stamp
        assert (stamp.sec, stamp.nanosec) == (1, 500_000_000)
    assert not read(path)[0]  # of no use to mapping


def fix(covariance: np.ndarray, status: int = 0) -> SatelliteFix:
    return SatelliteFix(1.5, 52.123456789, -13.25, 80.5, covariance, status)


@pytest.mark.parametrize("known", [True, False])
def test_fixes_of_a_receiver_survive(tmp_path: Path, known: bool) -> None:
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 16.0]])
    covariance = covariance if known else np.full((3, 3), math.nan)
    path = record(tmp_path / "a.mcap", fix(covariance), fix(covariance, -1))
    (back, none), _ = read(path)
    assert isinstance(back, SatelliteFix)
    assert isinstance(none, SatelliteFix)
    assert (back.stamp, back.latitude, back.longitude, back.altitude) == (
        1.5,
        52.123456789,
        -13.25,
        80.5,
    )
    np.testing.assert_array_equal(back.covariance, covariance)
    assert (back.status, none.status) == (0, -1)


def test_a_covariance_of_zeros_is_none(tmp_path: Path) -> None:
    """Drivers leave zeros where they know nothing, whatever type they claim."""
    (back,), _ = read(record(tmp_path / "a.mcap", fix(np.zeros((3, 3)))))
    assert isinstance(back, SatelliteFix)
    assert np.isnan(back.covariance).all()


def test_intensities_are_recorded_if_known(tmp_path: Path) -> None:
    n = 3
    bright = np.array([1.0, 2.5, 0.0])
    scan = LaserScan(1.0, 0.1 * np.arange(n), np.ones(n), np.zeros(n), 0.0, 5.0, bright)
    with Reader(record(tmp_path / "a.mcap", scan)) as reader:
        ((c, _, data),) = reader.messages([c for c in reader.connections if c.topic == "/scan"])
        found = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, c.msgtype)
    np.testing.assert_array_equal(found.intensities, bright)
    (back,) = read(tmp_path / "a.mcap")[0]
    assert isinstance(back, LaserScan)
    np.testing.assert_array_equal(back.intensities, bright)


@pytest.mark.parametrize(
    ("title", "topic"),
    [("urg", "urg"), ("9 dof!", "_9_dof"), ("a/b", "a_b"), ("", "_"), ("Lidar-2", "Lidar_2")],
)
def test_device_titles_as_topics(title: str, topic: str) -> None:
    assert topic_name(title) == topic


def test_messages_without_a_ros_type_are_rejected(tmp_path: Path) -> None:
    with (
        McapWriter(tmp_path / "a.mcap") as writer,
        pytest.raises(MessageError, match="Steering has no ROS type"),
    ):
        writer.write(Steering(1.0, 0.5, 0.1))


def test_the_topic_of_a_receiver_is_reported(tmp_path: Path) -> None:
    config = load("imp", ['sensors.gps.kind="navsat"', 'estimator.kind="landmarks"'])
    for what, said in (
        (fix(np.eye(3)), "gps /fix"),
        (Climate(1.5, 20.0, 0.5), "gps finds nothing"),
    ):
        path = record(tmp_path / f"{type(what).__name__}.mcap", what)
        with recognise(path)(path=path) as source:
            assert said in choices(config, source)
