"""Small logs of every format, written by hand, with values that are exact in binary."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.sources.base import Source, recognise
from impslam.sources.recording import McapWriter
from impslam.types import (
    Image,
    Imu,
    LaserScan,
    Message,
    OdometryPose,
    TruePose,
    WheelAngles,
)

CARMEN_RANGES = [0.25 + 0.25 * i for i in range(180)]


def flaser(stamp: float, ranges: Iterable[float] = CARMEN_RANGES, name: str = "FLASER") -> str:
    values = list(ranges)
    words = [name, len(values), *values, 9, 9, 9, 1.5, -2.5, 0.75, f"{stamp:.6f}", "host", 0.5]
    return " ".join(map(str, words))


def odom(stamp: float, x: float = 1.0) -> str:
    return f"ODOM {x} 2.0 0.5 0.1 0.2 0 {stamp:.6f} host 0.0"


def robot_laser(stamp: float, n: int = 4, start: float = -1.5, remissions: int = 0) -> str:
    ranges, dim = [0.5] * n, [7] * remissions
    head = ["ROBOTLASER1", 0, start, 3.0, 0.5, 81.9, 0.1, 0, n, *ranges, remissions, *dim]
    words = [*head, 1.22, 2, 0.5, 1, 2, 0.5, 0, 0, 0, 0, 0, f"{stamp:.6f}", "host", 0]
    return " ".join(map(str, words))


def dat_line(count: int, left: int, right: int, ranges: Iterable[int] | None = None) -> str:
    values = range(682) if ranges is None else ranges
    return " ".join(map(str, [count, 14000, left, right, *[0] * 20, *values, 0]))


def write_carmen(path: Path) -> Path:
    lines = ["# CARMEN Logfile", "PARAM robot_length 0.5 nohost 0", odom(10.0), flaser(10.25)]
    lines += [odom(10.5, 1.5), flaser(10.75)]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_dat(path: Path) -> Path:
    path.write_text("".join(dat_line(100_000 * i, 5 * i, 7 * i) + "\n" for i in range(1, 4)))
    return path


def write_lego(folder: Path, newline: str = "\n") -> Path:
    folder.mkdir(exist_ok=True)
    motors = [f"M {250 * i} {100 + i} 1 2 3 {200 + i} 4 5 6 0 0 0 0" for i in range(4)]
    scans = [f"S {250 * i + 575} 660 " + " ".join(["1500"] * 660) for i in range(3)]
    for name, lines in (("motors", motors), ("scan", scans), ("reference", ["P 0 1 2"])):
        (folder / f"run_{name}.txt").write_bytes((newline.join(lines) + newline).encode())
    return folder


def messages() -> list[Message]:
    """One message or more of each type, with values single precision can hold."""
    n = 5
    angles, times = -0.5 + 0.25 * np.arange(n), 0.125 * np.arange(n)
    ranges = np.array([0.0, 1.5, math.nan, math.inf, -1.0])
    return [
        TruePose(100.0, np.array([1.0, 2.0, 0.0])),
        WheelAngles(100.125, 0.1, -12345.678),
        LaserScan(100.1, angles, ranges, times, 0.25, 8.0),
        Imu(100.2, np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 9.81])),
        Imu(100.3, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.6, 0.8])),
        Image(100.4, "jpeg", b"\xff\xd8 not really \xff\xd9"),
        OdometryPose(100.5, np.array([0.3, -0.7, 3.0])),
        WheelAngles(100.4, 0.2, 1e9),
    ]


def write_mcap(path: Path) -> Path:
    with McapWriter(path) as writer:
        for message in messages():
            writer.write(message)
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "carmen": write_carmen,
    "dat": write_dat,
    "lego": write_lego,
    "rosbag": write_mcap,
}


def read(path: Path, **parameters: object) -> tuple[list[Message], Source]:
    with recognise(path)(path=path, **parameters) as source:
        return list(source), source


def read_or_refuse(path: Path) -> None:
    """Read a damaged log: refused in one line, or read with sound messages only."""
    try:
        found, source = read(path)
        with recognise(path)(path=path) as again:
            again.streams()
    except ImpError as error:
        said = str(error)
        found, source = [], None
    if source is None:
        assert "\n" not in said
        assert path.name in said
        return
    for message in found:
        assert_sound(message)
    for example in source.problems.examples.values():
        assert "\n" not in example
        assert str(path) in example


def assert_sound(message: Message) -> None:
    assert math.isfinite(message.stamp)
    match message:
        case OdometryPose() | TruePose():
            assert np.isfinite(message.pose).all()
        case WheelAngles():
            assert math.isfinite(message.left)
            assert math.isfinite(message.right)
        case LaserScan():
            assert np.isfinite(message.angles).all()
            assert np.isfinite(message.time_offsets).all()
            assert message.ranges.dtype == np.float64


def assert_same(a: Message, b: Message) -> None:
    assert type(a) is type(b)
    for name in type(a).__slots__:
        np.testing.assert_equal(getattr(a, name), getattr(b, name), err_msg=name)
