"""Small logs of every format, written by hand, with values that are exact in binary."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from scipy.io import savemat

from impslam import columns
from impslam.errors import ImpError
from impslam.sources.base import Source, recognise
from impslam.sources.recording import McapWriter
from impslam.types import (
    Detections,
    Image,
    Imu,
    LaserScan,
    Message,
    OdometryPose,
    Steering,
    TruePose,
    Velocity,
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


def raw_laser(stamp: float, n: int = 4, start: float = -1.5, remissions: int = 0) -> str:
    """The same scan as that of `robot_laser`, without the poses."""
    words = robot_laser(stamp, n, start, remissions).split()
    return " ".join(["RAWLASER1", *words[1:-14], *words[-3:]])


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


def write_acfr_carpark(path: Path) -> Path:
    """Two fixes, three readings of the wheels and two scans, of which the second shows a beacon."""
    echoes = np.zeros((2, 361), np.uint16)
    echoes[1, 180:182] = 8192
    table = {
        "Time": [1.0, 1.125, 1.25, 1.375, 1.5, 1.625, 1.75],
        "Sensor": [2, 1, 3, 2, 3, 1, 2],
        "Index": [1, 1, 1, 2, 2, 2, 3],
        "TimeGPS": [1.125, 1.625],
        "GPSLon": [4.0, 4.5],
        "GPSLat": [-2.0, -2.25],
        "Time_VS": [1.0, 1.375, 1.75],
        "Velocity": [0.5, 0.75, 1.0],
        "Steering": [0.0, 0.125, -0.25],
        "TimeLaser": [1.25, 1.5],
        "Laser": np.full((2, 361), 5.5),
        "Intensity": echoes,
    }
    with path.open("wb") as file:
        savemat(file, table)
    return path


def write_acfr_park(folder: Path) -> Path:
    folder.mkdir()
    cells = np.empty(3, object)
    cells[:] = [
        np.array([[8.0, 16.0], [0.5, 2.0], [0.25, 0.75]]),
        np.zeros((0, 0)),
        np.ones((3, 1)),
    ]
    u = np.array([[1.0, 1.5, 2.0, 0.0], [0.0, 0.125, 0.25, 0.5]])
    trees = {"time": [1.0, 1.25, 1.5, 1.75], "u": u, "TLsr": [1.125, 1.25, 1.625], "zt": cells}
    savemat(folder / "log.mat", trees)
    gps = {"timeGps": [1125, 1500], "Lo_m": [4.0, 4.5], "La_m": [-2.0, -2.25]}
    savemat(folder / "gps.mat", gps)
    return folder


MRCLAM = {
    "Barcodes": ["1 5", "2 14", "6 63", "7 81"],
    "Robot2_Odometry": [f"{100 + 0.25 * i} 0.125 -0.5" for i in range(9)],
    "Robot2_Measurement": ["100.5 63 2.5 0.25", "100.5 14 1.0 0.0", "100.507 81 3.0 -0.25"]
    + [f"{101 + 0.25 * i} 81 3.25 -0.5" for i in range(4)],
    "Robot2_Groundtruth": [f"{99 + 0.125 * i} 1.5 {i} -3.0" for i in range(24)],
    "Landmark_Groundtruth": ["6 1.0 2.0 0.001 0.001", "7 -1.5 0.5 0.001 0.001"],
}


def write_mrclam(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for name, lines in MRCLAM.items():
        text = "# UTIAS Multi-Robot\n# Time [s] ...\n" + "".join(f" {line} \t\n" for line in lines)
        (folder / f"{name}.dat").write_text(text)
    return folder


def write_mrpt_text(path: Path) -> Path:
    steps = [
        "# ODOINC t dx dy dphi ; BR t sx sy sphi n (id range yaw pitch)...",
        "BR 1571493463.36 0 0 0 2 7 2.5 0.25 0.0 -1 1.5 -0.5 0.0",
        "ODOINC 0.0 0.5 0.0 0.25 0 enc 0 0 0",
        "BR 1571493463.36 0 0 0 1 7 2.0 0.5 0.0",
        "ODOINC 0.0 0.5 0.125 -0.25 0 enc 0 0 0",
        "BR 1571493463.36 0 0 0 0",
    ]
    path.write_text("\n".join(steps) + "\n")
    return path


def write_csv(path: Path) -> Path:
    rows = ["stamp,x,y,theta,-90,-45,0,45,90"]
    rows += [f"{1.5 + 0.25 * i},{0.5 * i},0.25,-0.5,1.5,{1 + i},inf,,0.5" for i in range(4)]
    path.write_text("\n".join(rows) + "\n")
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "acfr_carpark": write_acfr_carpark,
    "acfr_park": write_acfr_park,
    "carmen": write_carmen,
    "csv": write_csv,
    "dat": write_dat,
    "lego": write_lego,
    "mrclam": write_mrclam,
    "mrpt_text": write_mrpt_text,
    "rosbag": write_mcap,
}


def read(path: Path, **parameters: object) -> tuple[list[Message], Source]:
    with recognise(path)(path=path, **parameters) as source:
        return list(columns.messages(source.batches())), source


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
        case OdometryPose():
            assert np.isfinite(message.pose).all()
        case TruePose():  # the heading is not always tracked
            assert np.isfinite(message.pose[:2]).all()
        case Steering():
            assert math.isfinite(message.speed)
            assert math.isfinite(message.angle)
        case Velocity():
            assert math.isfinite(message.speed)
            assert math.isfinite(message.turn_rate)
        case Detections():
            assert message.ranges.dtype == message.bearings.dtype == np.float64
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
