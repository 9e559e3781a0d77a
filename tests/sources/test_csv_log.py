"""CSV logs: what their headers say, and what is said of them."""

import math
from pathlib import Path

import numpy as np
import pytest
from tests.sources.logs import read

import impslam
from impslam.cli import main
from impslam.config_from_log import choices
from impslam.errors import SourceError
from impslam.open_log import open_log
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan, Message, OdometryPose, TruePose, Velocity, WheelAngles


def log(path: Path, *lines: str) -> Path:
    file = path / "log"
    file.write_text("\n".join(lines) + "\n")
    return file


def messages(path: Path, *lines: str, **parameters: object) -> list[Message]:
    return read(log(path, *lines), **parameters)[0]


@pytest.mark.parametrize("mark", [",", ";", "\t", " , "])
def test_beams_that_are_named_by_degrees(tmp_path: Path, mark: str) -> None:
    rows = ["stamp,x,y,theta,-90,0,90", "12.5,1,2,0.5,1.5,,inf", "13.0,1,2,0.5,4,5,6"]
    pose, scan, *_ = messages(tmp_path, *(row.replace(",", mark) for row in rows))
    assert isinstance(pose, OdometryPose)
    assert isinstance(scan, LaserScan)
    assert pose.stamp == scan.stamp == 12.5
    np.testing.assert_array_equal(pose.pose, [1.0, 2.0, 0.5])
    np.testing.assert_allclose(scan.angles, [-math.pi / 2, 0.0, math.pi / 2])
    np.testing.assert_array_equal(scan.ranges, [1.5, math.nan, math.inf])


@pytest.mark.parametrize("mark", [" ", "   ", " \t"])
def test_spaces_separate_cells(tmp_path: Path, mark: str) -> None:
    """Quotes enclose them; a range that is missing is NaN."""
    rows = ['t,x,"y (mm)",theta,-90,0,90', "12.5,1,2000,0.5,1.5,nan,6", " 13.0,1,2000,0.5,4,5,6 "]
    pose, scan, *rest = messages(tmp_path, *(row.replace(",", mark) for row in rows))
    assert isinstance(pose, OdometryPose)
    assert isinstance(scan, LaserScan)
    np.testing.assert_array_equal(pose.pose, [1.0, 2.0, 0.5])
    np.testing.assert_array_equal(scan.ranges, [1.5, math.nan, 6.0])
    assert [one.stamp for one in rest] == [13.0, 13.0]


@pytest.mark.parametrize("header", ["t x y theta r0 r1 r2", "drive 7\nt x y theta r0 r1 r2"])
def test_what_numpy_writes(tmp_path: Path, header: str) -> None:
    table = np.array([[1.0, 1.0, 2.0, 0.5, 4.0, 5.0, 6.0], [2.0, 1.0, 2.0, 0.5, 4.0, np.nan, 6.0]])
    np.savetxt(tmp_path / "log", table, header=header)
    angles = {"angle_min": -0.5, "angle_step": 0.5}
    found, source = read(tmp_path / "log", **angles)
    assert not source.problems.counts
    poses, scans = found[::2], found[1::2]
    assert [[pose.stamp, *pose.pose.tolist()] for pose in poses] == table[:, :4].tolist()
    np.testing.assert_array_equal([scan.ranges for scan in scans], table[:, 4:])


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_outer_cells_may_be_empty(tmp_path: Path, mark: str) -> None:
    rows = ["-90,0,90,x,y,theta,t", ",2,3,1,2,0.5,1.0", "1,2,3,,,,2.0", "-90,,,1,2,0.5,3.0"]
    turned = [mark.join(row.split(",")[::-1]) for row in rows]  # the last cells are empty, too
    for lines in ([row.replace(",", mark) for row in rows], turned):
        scans = [m for m in messages(tmp_path, *lines) if isinstance(m, LaserScan)]
        assert [scan.stamp for scan in scans] == [1.0, 2.0, 3.0]
        assert [int(np.isnan(scan.ranges).sum()) for scan in scans] == [1, 0, 2]


HEADER, ROW = "t,x,y,theta,-90,0,90", "1.0,1,2,0.5,4,5,6"


@pytest.mark.parametrize(
    "opening",
    [
        ["# recorded by my logger", HEADER],
        ["\ufeff# lidar: A1, 8 m, at 10 Hz", "", "# floor 2", HEADER],
        ["# floor 2", f"# {HEADER}", "# s,m,m,rad,m,m,m"],
        [f"#{HEADER}", "# in m and rad, of floor 2"],
        [HEADER, "# in m and rad, of floor 2"],
    ],
)
def test_comments_before_the_first_row(tmp_path: Path, opening: list[str]) -> None:
    found, source = read(log(tmp_path, *opening, ROW, "# pause", ROW.replace("1.0", "2.0")))
    assert not source.problems.counts
    assert [type(m) for m in found] == 2 * [OdometryPose, LaserScan]
    np.testing.assert_allclose(found[1].angles, [-math.pi / 2, 0.0, math.pi / 2])


def test_comments_before_rows_without_a_header(tmp_path: Path) -> None:
    columns = {"stamp": "1", "x": "2", "y": "3", "theta": "4", "ranges": "5:7"}
    lines = ["# recorded by my logger", ROW, ROW]
    found = messages(tmp_path, *lines, columns=columns, angle_min=-0.5, angle_step=0.5)
    assert [type(m) for m in found] == 2 * [OdometryPose, LaserScan]


@pytest.mark.parametrize(
    ("header", "kind"),
    [
        ("Time,left,right,0,90,180", WheelAngles),
        ("# t,v,omega,0,90,180", Velocity),
        ("timestamp,odom_x,odom_y,yaw_deg,0,90,180", OdometryPose),
    ],
)
def test_odometry_by_its_names(tmp_path: Path, header: str, kind: type[Message]) -> None:
    row = ",".join(["1.5"] * len(header.split(",")))
    assert [type(m) for m in messages(tmp_path, header, row)] == [kind, LaserScan]


def test_units_in_names(tmp_path: Path) -> None:
    header = "time_ms,x_mm,y_cm,theta_deg,range_mm_0,range_mm_1,range_mm_2"
    pose, scan = messages(
        tmp_path, header, "1500,250,25,90,1000,2000,", angle_min=-0.5, angle_step=0.5
    )
    assert isinstance(pose, OdometryPose)
    assert isinstance(scan, LaserScan)
    assert pose.stamp == 1.5
    np.testing.assert_allclose(pose.pose, [0.25, 0.25, math.pi / 2])
    np.testing.assert_array_equal(scan.ranges, [1.0, 2.0, math.nan])
    np.testing.assert_array_equal(scan.angles, [-0.5, 0.0, 0.5])


@pytest.mark.parametrize(
    "beam", ["r{} [mm]", "r{} (mm)", "r_{}_mm", "ranges[{}] [mm]", "range_mm_{}"]
)
def test_units_of_ranges_before_and_after_their_numbers(tmp_path: Path, beam: str) -> None:
    header = ",".join(["t", *(beam.format(k) for k in (8, 9, 10))])
    (scan,) = messages(tmp_path, header, "1.5,1000,2000,", angle_min=-0.5, angle_step=0.5)
    np.testing.assert_array_equal(scan.ranges, [1.0, 2.0, math.nan])  # type: ignore[attr-defined]


def test_columns_given_by_the_user(tmp_path: Path) -> None:
    columns = {"stamp": "secs", "x": "px", "y": "py", "theta": "dir*0.5", "ranges": "d0:d2*0.001"}
    rows = ["secs,px,py,dir,note,d0,d1,d2", "1.5,1,2,3,hello,1000,2000,3000"]
    pose, scan = messages(tmp_path, *rows, columns=columns, angle_min=1.0, angle_step=-1.0)
    np.testing.assert_array_equal(pose.pose, [1.0, 2.0, 1.5])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(scan.ranges, [1.0, 2.0, 3.0])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(scan.angles, [1.0, 0.0, -1.0])  # type: ignore[attr-defined]


def test_without_a_header_columns_have_numbers(tmp_path: Path) -> None:
    columns = {"stamp": "1", "left": "2", "right": "3", "ranges": "4:6"}
    rows = ["1.5,1,2,3,4,5", "2.5,1,2,3,4,5"]
    found = messages(tmp_path, *rows, columns=columns, angle_min=0.0, angle_step=0.1)
    assert [(type(m), m.stamp) for m in found] == [
        (WheelAngles, 1.5), (LaserScan, 1.5), (WheelAngles, 2.5), (LaserScan, 2.5),
    ]  # fmt: skip


def test_numbers_of_columns_are_not_directions_of_beams(tmp_path: Path) -> None:
    columns = {"stamp": "1", "ranges": "4:6"}
    with pytest.raises(SourceError, match=r"directions of the beams are unknown: give --set"):
        messages(tmp_path, *2 * ["1.5,1,2,3,4,5"], columns=columns)


def test_what_rostopic_echo_writes(tmp_path: Path) -> None:
    """`rostopic echo -p /scan`, with stamps in ns and a frame between the numbers."""
    names = [
        "angle_min",
        "angle_max",
        "angle_increment",
        "time_increment",
        "scan_time",
        "range_min",
        "range_max",
        "ranges0",
        "ranges1",
    ]
    header = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    header += [f"field.{name}" for name in [*names, "ranges2"]]
    row = ["1700000000500000000", "7", "1700000000250000000", "laser", "-1", "0", "0.5", "0.02"]
    row += ["0.1", "0.1", "8", "1", "2", "inf"]
    without = ["nan" if k == 7 else cell for k, cell in enumerate(row)]
    found, source = read(log(tmp_path, *map(",".join, (header, row, without))))
    assert source.problems.counts == {"malformed row": 1}
    assert "time_increment is not finite" in source.problems.examples["malformed row"]
    (scan,) = found
    assert isinstance(scan, LaserScan)
    np.testing.assert_array_equal(scan.time_offsets, [0.0, 0.02, 0.04])
    assert scan.stamp == 1700000000.25
    np.testing.assert_array_equal(scan.angles, [-1.0, -0.5, 0.0])
    np.testing.assert_array_equal(scan.ranges, [1.0, 2.0, math.inf])
    assert (scan.range_min, scan.range_max) == (0.1, 8.0)


ECHO = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.{}"


def test_rostopic_echo_of_simulated_time(tmp_path: Path) -> None:
    """It writes ns, however few of them there are."""
    header = ECHO.format(
        "angle_min,field.angle_increment,field.ranges0,field.ranges1,field.ranges2"
    )
    rows = [f"{t},7,{t},laser,-1,0.5,1,2,3" for t in (0, 5_200_000_000, 2_300_000_000_000)]
    assert [m.stamp for m in messages(tmp_path, header, *rows)] == [0.0, 5.2, 2300.0]
    named = {"stamp": "field.header.stamp"}
    assert [m.stamp for m in messages(tmp_path, header, *rows, columns=named)] == [0.0, 5.2, 2300.0]


def covariance(of: str) -> str:
    return ",".join(f"field.{of}.covariance{k}" for k in range(36))


def test_rostopic_echo_of_odometry(tmp_path: Path) -> None:
    pose = ",field.".join(f"pose.pose.position.{c}" for c in "xyz")
    turn = ",".join(f"field.pose.pose.orientation.{c}" for c in "xyzw")
    twist = ",".join(f"field.twist.twist.{v}.{c}" for v in ("linear", "angular") for c in "xyz")
    header = ",".join([ECHO.format(pose), turn, covariance("pose"), twist, covariance("twist")])
    zeros = ",".join(["0"] * 36)
    row = f"1,7,2000000000,odom,1.5,-2.5,9,0,0,2,2,{zeros},0.5,0,0,0,0,0.25,{zeros}"
    unturned = row.replace("0,0,2,2", "0,0,0,0")
    found, source = read(log(tmp_path, header, row, unturned))
    (only,) = found
    assert isinstance(only, OdometryPose)
    assert only.stamp == 2.0
    np.testing.assert_allclose(only.pose, [1.5, -2.5, math.pi / 2])
    with source:
        assert source.kinds() == {OdometryPose}
    assert "the orientation is a zero quaternion" in source.problems.examples["malformed row"]


def test_rostopic_echo_of_velocities(tmp_path: Path) -> None:
    names = ",field.".join(f"twist.{v}.{c}" for v in ("linear", "angular") for c in "xyz")
    (only,) = messages(tmp_path, ECHO.format(names), "1,7,2000000000,base,0.5,0,0,0,0,0.25")
    assert isinstance(only, Velocity)
    assert (only.stamp, only.speed, only.turn_rate) == (2.0, 0.5, 0.25)


def test_lines_of_different_length_are_explained(tmp_path: Path) -> None:
    path = log(tmp_path, "0.0, 1, 2, 3, 4, 5", "0.1, 1, 2, 3, 4, 5, 6, 7")
    with pytest.raises(SourceError, match="its first line has 6 cells and its second 8; write"):
        read(path)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            ["stamp", "1.5"],
            "its lines have 1 cell instead of 4 or more; write a stamp and the ranges",
        ),
        (
            ["stamp;x;y", "0,5;1,0;2,0"],
            "its lines have 3 cells instead of 4 or more; write a stamp",
        ),
        (["1,2,3", "4,5,6"], "its lines have 3 cells instead of 4 or more; write a stamp"),
        (["t,x,y,theta,0,1,2"], "it has a single line; write the names of the columns in it"),
        (
            ["t,x,y,theta", "s,m,m,rad", "1,2,3,4"],
            "its second line has fewer than 4 numbers; write",
        ),
        (["t,x,y,theta,0", "1,2,3"], "its first line has 5 cells and its second 3; write"),
        (["t;x;y;theta;0", "1,2,3,4,5"], "has 1 cell and its second 5; .*, separated alike, and"),
        (["t,0,1,2", "0,5,1,5,2,0,3,5"], "second 8; .* separated alike, with decimal points, and"),
    ],
)
def test_tables_that_are_no_log_are_explained(tmp_path: Path, lines: list[str], said: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SourceError, match=f"no known log format.*; for a CSV log, .*{said}"):
        read(path)


def test_other_files_are_not_said_to_be_csv(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("1,2,3\n4,5,6\n")
    with pytest.raises(SourceError, match="write stamps, poses and ranges of another format as"):
        read(path)


@pytest.mark.parametrize("mark", [";", "\t", "|"])
@pytest.mark.parametrize(
    "header", ["t,x,y,theta,-90,0,90", '"t","x","y","theta","-90","0","90"', None]
)
def test_decimal_commas_and_quotes_of_spreadsheets(
    tmp_path: Path, header: str | None, mark: str
) -> None:
    row = "1,5;1,25;2,0;-0,5;4,25;;inf".replace(";", mark)
    given = {"columns": dict(zip(("stamp", "x", "y", "theta", "ranges"), "12345", strict=True))}
    given["columns"]["ranges"] = "5:7"
    lines = [row, row] if header is None else [header.replace(",", mark), row, row]
    others = {**given, "angle_min": 0.0, "angle_step": 0.1} if header is None else {}
    pose, scan, *_ = messages(tmp_path, *lines, **others)
    assert isinstance(pose, OdometryPose)
    assert isinstance(scan, LaserScan)
    assert pose.stamp == 1.5
    np.testing.assert_array_equal(pose.pose, [1.25, 2.0, -0.5])
    np.testing.assert_array_equal(scan.ranges, [4.25, math.nan, math.inf])


def test_quoted_cells_and_row_numbers_of_data_frames(tmp_path: Path) -> None:
    rows = ['"","t","x","y","theta","-90","0","90"', '"0","1.5","1","2","0.5","4","5","6"']
    pose, scan = messages(tmp_path, *rows)
    np.testing.assert_array_equal(pose.pose, [1.0, 2.0, 0.5])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(scan.ranges, [4.0, 5.0, 6.0])  # type: ignore[attr-defined]


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("header", ["t,x,note,y,theta,-90,0,90", None])
def test_quotes_enclose_what_separates_cells(tmp_path: Path, header: str | None, mark: str) -> None:
    row = '1.5,1,"ok@ ""fast""@ 2","2",0.5,4,,inf'.replace(",", mark).replace("@", mark)
    roles = {"stamp": "1", "x": "2", "y": "4", "theta": "5", "ranges": "6:8"}
    others = {} if header else {"columns": roles, **STEPS}
    lines = [header.replace(",", mark)] if header else []
    pose, scan, *_ = messages(tmp_path, *lines, row, row, **others)
    np.testing.assert_array_equal(pose.pose, [1.0, 2.0, 0.5])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(scan.ranges, [4.0, math.nan, math.inf])  # type: ignore[attr-defined]


def test_a_decimal_comma_in_quotes_is_no_number_where_commas_separate(tmp_path: Path) -> None:
    """It may also separate thousands."""
    lines = ["t,x,y,theta,-90,0,90", ROW, '2.0,"1,250",2,0.5,4,5,6']
    found, source = read(log(tmp_path, *lines))
    assert [m.stamp for m in found] == [1.0, 1.0]
    assert "'1,250' is not a number" in source.problems.examples["malformed row"]


@pytest.mark.parametrize("mark", [",", ";"])
@pytest.mark.parametrize("ends", ["[]", "()"])
def test_all_ranges_in_one_cell(tmp_path: Path, mark: str, ends: str) -> None:
    """As Python programs write ROS messages; their dates have slashes."""
    header = "time,header,angle_min,angle_increment,range_max,.ranges,.intensities"
    row = '2024/05/01 10:00:00.250000123;"{\'secs\': 7, \'nsecs\': 5}";-1;0.5;8;"@";"@"'
    for ranges in ("1.25, 2.5, inf", "1.25, 2.5"):
        row = row.replace("@", f"{ends[0]}{ranges}{ends[1]}", 1)
    lines = [row, row.replace("1.25, 2.5, inf", "1.25, 2.5")]
    found, source = read(
        log(tmp_path, header.replace(",", mark), *(line.replace(";", mark) for line in lines))
    )
    (scan,) = found
    assert isinstance(scan, LaserScan)
    assert scan.stamp == 1714557600.25
    np.testing.assert_array_equal(scan.ranges, [1.25, 2.5, math.inf])
    np.testing.assert_array_equal(scan.angles, [-1.0, -0.5, 0.0])
    assert (
        "9 cells instead of 10; write every line with as many"
        in source.problems.examples["malformed row"]
    )


@pytest.mark.parametrize(
    "stamp",
    [
        "2024-05-01T10:00:00.25",
        "2024-05-01 10:00:00.250000",
        "2024-05-01T12:00:00.25+02:00",
        "2024/05/01/10:00:00.250000",
        "01.05.2024 10:00:00.25",
        "1.5.2024  10:00:00.25",
    ],
)
@pytest.mark.parametrize("has_header", [True, False])
def test_stamps_that_are_dates(tmp_path: Path, stamp: str, has_header: bool) -> None:
    row = f"{stamp},4,5,6,7"
    columns = {} if has_header else {"columns": {"stamp": "1", "ranges": "2:5"}}
    lines = ["time,0,1,2,3", row] if has_header else [row, row]
    scan, *_ = messages(tmp_path, *lines, **columns, **({} if has_header else STEPS))
    assert scan.stamp == 1714557600.25


def test_times_of_day_continue_after_midnight(tmp_path: Path) -> None:
    stamps = [
        "23:59:59.5",
        "23:59:59.75",
        "0:00:00.25",
        "00:00:00",
        "11:00:00",
        "22:00:00",
        "0:00:01",
    ]
    found = messages(tmp_path, "time;0;1;2", *(f"{stamp};4;5;6" for stamp in stamps))
    after = [-0.5, -0.25, 0.25, 0.0, 39600.0, 79200.0, 86401.0]
    assert [scan.stamp - 86400.0 for scan in found] == after


def test_days_of_which_the_month_would_be_a_guess_are_not_read(tmp_path: Path) -> None:
    row = "05/01/2024 10:00:00,4,5,6,7"
    found, source = read(log(tmp_path, "time,0,1,2,3", row, row))
    assert not found
    said = "is not a number, or a time such as 2024-12-31T09:00:00.25; the line is dropped"
    assert said in source.problems.examples["malformed row"]


@pytest.mark.parametrize("word", ["#N/A", "NA", "null", "None", "#NV", "<NA>"])
def test_words_for_missing_values_are_empty_cells(tmp_path: Path, word: str) -> None:
    rows = [f"1,1,2,0.5,4,{word},6", f"2,{word},{word},{word},4,5,6", f"3,{word},2,3,4,5,6"]
    found, source = read(log(tmp_path, "t,x,y,theta,-90,0,90", *rows))
    assert [(m.stamp, type(m)) for m in found] == [
        (1.0, OdometryPose), (1.0, LaserScan), (2.0, LaserScan),
    ]  # fmt: skip
    np.testing.assert_array_equal(found[1].ranges, [4.0, math.nan, 6.0])
    assert source.problems.counts == {"malformed row": 1}


STEPS: dict[str, object] = {"angle_min": 0.0, "angle_step": 0.1}


def test_an_empty_stamp_beside_seconds_and_nanoseconds_is_not_read(tmp_path: Path) -> None:
    """As bag2csv writes a message: a column for each part of it, empty if the part has parts."""
    head = "rosbagTimestamp,header,seq,stamp,secs,nsecs,frame_id,angle_min,angle_increment,ranges"
    rows = [f'{k},,{k},,{k},500000000,"laser",0.0,1.0,"[1.0, 2.0, 3.0]"' for k in (1, 2)]
    assert [scan.stamp for scan in messages(tmp_path, head, *rows)] == [1.5, 2.5]


@pytest.mark.parametrize("prefix", ["", "header.stamp.", "stamp_"])
@pytest.mark.parametrize("names", ["sec,nanosec", "secs,nsecs"])
def test_stamps_of_whole_seconds_and_nanoseconds(tmp_path: Path, prefix: str, names: str) -> None:
    header = ",".join([*(prefix + name for name in names.split(",")), "-90,0,90"])
    rows = ["1700000000,750000000,4,5,6", "1700000001,250000000,4,5,6"]
    scans = messages(tmp_path, header, *rows)
    assert [scan.stamp for scan in scans] == [1700000000.75, 1700000001.25]


def test_nanoseconds_do_not_belong_to_a_stamp_with_a_fraction(tmp_path: Path) -> None:
    rows = ["Time,header.stamp.secs,header.stamp.nsecs,-90,0,90", *2 * ["8.5,8,500000000,4,5,6"]]
    assert messages(tmp_path, *rows)[0].stamp == 8.5


def test_what_ros2_topic_echo_writes(tmp_path: Path) -> None:
    rows = [f"{k},500000000,laser,-1,1,1,0.02,0.1,0.2,8.0,4,5,6" for k in range(3)]
    given = dict(
        zip(("stamp", "nanosec", "angle_min", "angle_step", "time_step"), "12467", strict=True)
    )
    given |= {"range_max": "10", "ranges": "11:13"}
    scan = messages(tmp_path, *rows, columns=given)[-1]
    assert isinstance(scan, LaserScan)
    assert (scan.stamp, scan.range_max) == (2.5, 8.0)
    np.testing.assert_array_equal(scan.angles, [-1.0, 0.0, 1.0])
    np.testing.assert_array_equal(scan.time_offsets, [0.0, 0.02, 0.04])


def test_units_in_brackets(tmp_path: Path) -> None:
    header = "Time [ms],x (mm),y[cm],heading (deg),-90,0,90"
    pose, _ = messages(tmp_path, header, "1500,250,25,90,1,2,3")
    assert pose.stamp == 1.5
    np.testing.assert_allclose(pose.pose, [0.25, 0.25, math.pi / 2])  # type: ignore[attr-defined]
    speed, _ = messages(tmp_path, "t,v [mm/s],omega [deg/s],0,1,2", "1,500,90,1,2,3")
    assert isinstance(speed, Velocity)
    assert (speed.speed, speed.turn_rate) == pytest.approx((0.5, math.pi / 2))


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_the_sign_of_degrees_in_either_encoding(tmp_path: Path, encoding: str) -> None:
    path = log(tmp_path)
    text = "t [µs],x,y,theta (°),-90,0,90\n1500000,2,3,90,1,2,3\n"
    path.write_bytes(text.encode(encoding))
    pose, _ = read(path)[0]
    assert pose.stamp == 1.5
    np.testing.assert_allclose(pose.pose, [2.0, 3.0, math.pi / 2])


def test_directions_of_beams_with_decimal_commas(tmp_path: Path) -> None:
    _, scan = messages(tmp_path, "t;x;y;theta;-0,5;0,25;1", "1;2;3;0,5;1,5;2;3")
    np.testing.assert_allclose(scan.angles, np.radians([-0.5, 0.25, 1.0]))  # type: ignore[attr-defined]
    np.testing.assert_array_equal(scan.ranges, [1.5, 2.0, 3.0])  # type: ignore[attr-defined]


def test_a_log_whose_ranges_are_all_empty_says_so(tmp_path: Path) -> None:
    path = log(tmp_path, "t,x,y,theta,0,1,2", "1,1,2,3,nan,nan,nan", "2,1,2,3,,,")
    with pytest.raises(
        SourceError, match="no usable scan; the ranges of all rows are empty or NaN"
    ):
        impslam.run(path)


def test_a_log_without_usable_rows_says_why(tmp_path: Path) -> None:
    path = log(tmp_path, "t,x,y,theta,0,1,2", "noon,1,2,3,4,5,6", "noon,1,2,3,4,5,6")
    with pytest.raises(
        SourceError, match=r"no usable scan; 2 x malformed row: .*'noon' is not a num"
    ):
        impslam.run(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 1 2 0.5 4 5 6\n2 1 2 0.5 4 5 6\n", "name the columns in its first line"),
        ("\ufefft,x,y,theta,0,1,2\n1,1,2,0.5,4,5,6\n", "in UTF-16; save it as UTF-8"),
    ],
)
def test_what_cannot_be_read_is_explained(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("utf-16-le" if "\ufeff" in text else "utf-8"))
    with pytest.raises(SourceError, match=f"no known log format.*{said}"):
        read(path)


def test_limits_that_no_range_can_keep_are_unset(tmp_path: Path) -> None:
    """Drivers that do not know their lidar write a range_max of 0."""
    (scan,) = messages(tmp_path, "stamp,range_min,range_max,0,1,2", "1,0.15,0,1,2,3")
    assert isinstance(scan, LaserScan)
    assert math.isnan(scan.range_min)
    assert math.isnan(scan.range_max)


def test_rows_may_contain_odometry_or_a_scan_only(tmp_path: Path) -> None:
    rows = ["stamp,left,right,0,1,2", "1,1,2,,,", "2,,,1,2,3", "3,1,2,1,2,3", "# no row", ""]
    assert [(m.stamp, type(m)) for m in messages(tmp_path, *rows)] == [
        (1.0, WheelAngles), (2.0, LaserScan), (3.0, WheelAngles), (3.0, LaserScan),
    ]  # fmt: skip


def test_bad_rows_are_counted_and_dropped(tmp_path: Path) -> None:
    rows = ["stamp,left,right,0,1,2", "1,1,2,3,4,5", "2,1,2,3,4", "x,1,2,3,4,5", "3,nan,2,3,4,5"]
    rows += [",1,2,3,4,5", "4,1,2,3,what,5", "5,1,2,3,4,5"]
    found, source = read(log(tmp_path, *rows))
    assert [m.stamp for m in found] == [1.0, 1.0, 5.0, 5.0]
    assert source.problems.counts == {"malformed row": 5}


@pytest.mark.parametrize(
    ("header", "parameters", "said"),
    [
        ("when,left,right,0,1,2", {}, r"no column for stamp found \(when, left, right, 0"),
        ("stamp,a,b,c,d,e", {}, "for ranges found .*: name it with --columns ranges=FIRST:LAST"),
        (
            "stamp,a,r0,r1,r2,r3",
            {},
            "directions of the beams are unknown: give --set source.angle_min",
        ),
        (
            "stamp,a,r0,r1,r2,r3",
            {"angle_min": 0.0, "angle_step": 6.0},
            "4 turns; write the angles of beams in rad",
        ),
        ("stamp,a,0,1,2,3", {"columns": {"x": "ab"}}, "no column 'ab'; did you mean 'a'"),
        (
            "stamp,r0,r1,r2,r3,a",
            {"columns": {"x": "bcd"}},
            "no column 'bcd'; known: stamp, a, r0 to r3$",
        ),
        (
            "0,1,0,0,0,0",
            {"columns": {"x": "0"}},
            "no column '0'; without a header, columns are called 1 to 6",
        ),
        ("stamp,a,0,1,2,3", {"columns": {"ranges": "0"}}, "expected ranges=FIRST:LAST"),
        ("stamp,a,0,1,2,3", {"columns": {"ranges": "2:0"}}, "0 is before 2"),
        ("stamp,a,0,1,2,3", {"columns": {"x": "a*b"}}, "'b' is not a number"),
    ],
)
def test_unknown_columns_are_errors(
    tmp_path: Path, header: str, parameters: dict[str, object], said: str
) -> None:
    path = log(tmp_path, header, "1,2,3,4,5,6")
    with pytest.raises(SourceError, match=said):
        read(path, **parameters)


def test_a_csv_log_is_mapped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Wheel angles, with the columns said on the command line; and by the lidar alone."""
    robot = SimulatedRobot(
        encoders=WheelEncoders.perfect(),
        lidar=Lidar.perfect(beam_time=0.0, mount=(0.0, 0.0, 0.0)),
        imu=None,
    )
    rows, truth, wheels = ["clock,enc_l,enc_r," + ",".join(f"b{k}" for k in range(682))], {}, {}
    for m in simulate(load_world("room"), robot):
        if isinstance(m, TruePose):
            truth[m.stamp] = m.pose
        elif isinstance(m, WheelAngles):
            wheels[m.stamp] = (m.left, m.right)
        elif isinstance(m, LaserScan):
            cells = [f"{r:.4f}" if r > 0.0 else "" for r in m.ranges]
            rows.append(",".join([f"{m.stamp:.6f}", *map(str, wheels[m.stamp]), *cells]))
    path = log(tmp_path, *rows)
    assert main(["run", str(path)]) == 2
    assert "no column for stamp found (clock, enc_l, enc_r, b0" in capsys.readouterr().err
    given = ["--columns", "stamp=clock,left=enc_l,right=enc_r", "--columns", "ranges=b0:b681"]
    for one in (f"angle_min={-340 * math.tau / 1024}", f"angle_step={math.tau / 1024}"):
        given += ["--set", f"source.{one}"]
    assert main(["run", str(path), *given, "-o", str(tmp_path / "alone"), "--quiet"]) == 0
    wheel = ["odometry.kind=encoders", "odometry.wheel_radius=0.0635", "odometry.track=0.4"]
    for one in wheel:
        given += ["--set", one]
    assert main(["run", str(path), *given, "-o", str(tmp_path / "wheels")]) == 0
    assert "odometry wheels" in capsys.readouterr().out
    for name in ("alone", "wheels"):
        known = impslam.Map.load(tmp_path / name / "map.imp")
        for stamp, *pose in known.path():
            nearest = min(truth, key=lambda t: abs(t - stamp))
            assert math.dist(pose[:2], truth[nearest][:2]) < 0.01


def test_speeds_and_turn_rates_are_odometry(tmp_path: Path) -> None:
    path = log(tmp_path, "t,speed,turn_rate,0,1,2", "0,1,0.2,0.5,4,5", "1,1,0.2,0.5,4,5")
    config, source = open_log(path)
    assert config.odometry == {"kind": "velocity"}
    assert "odometry velocity" in choices(config, source)
    config, _ = open_log(path, settings=["odometry.kind=lidar_only"])
    assert config.odometry["kind"] == "lidar_only"


@pytest.mark.parametrize("names", ["px,py,phi", "x,y,phi", "odometry_left,odometry_right,seq"])
def test_columns_that_may_be_odometry_are_named(tmp_path: Path, names: str) -> None:
    path = log(tmp_path, f"t,{names},0,1,2", "0,1,2,0.5,4,5,6", "1,1,2,0.5,4,5,6")
    config, source = open_log(path)
    assert config.odometry == {"kind": "lidar_only"}
    assert source.problems.counts == {"unknown odometry": 1}
    said = source.problems.examples["unknown odometry"]
    assert f"columns {names.replace(',', ', ')} are not read" in said
    assert "x+y+theta or " in said
    assert "--columns x=NAME,y=NAME,theta=NAME" in said


@pytest.mark.parametrize(
    "header",
    [
        "t,x,y,theta,0,1,2",
        "t,intensity0,intensity1,intensity2,0,1,2",
        ".header.seq,time,angle_max,scan_time,0,1,2",
        "%time,field.header.seq,0,1,2,3,4",
    ],
)
def test_other_columns_are_not_taken_for_odometry(tmp_path: Path, header: str) -> None:
    _, source = open_log(log(tmp_path, header, "0,1,2,0.5,4,5,6", "1,1,2,0.5,4,5,6"))
    assert not source.problems.counts


def test_a_run_without_the_odometry_of_its_config_names_the_columns(tmp_path: Path) -> None:
    path = log(tmp_path, "t,px,py,phi,0,1,2", "0,1,2,0.5,4,5,6", "1,1,2,0.5,4,5,6")
    with pytest.raises(SourceError, match="columns px, py, phi are not read"):
        impslam.run(path, "default")
