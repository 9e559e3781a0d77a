import gzip
import math
import time
from pathlib import Path

import numpy as np
import pytest
from tests.sources.logs import (
    CARMEN_RANGES,
    assert_same,
    flaser,
    odom,
    raw_laser,
    read,
    robot_laser,
    write_carmen,
)

from impslam.columns import messages
from impslam.config_from_log import choices
from impslam.errors import SourceError
from impslam.geometry.se2 import compose
from impslam.open_log import open_log
from impslam.sources import carmen
from impslam.sources.base import recognise
from impslam.types import LaserScan, OdometryPose


def log(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_lines_become_messages_in_file_order(tmp_path: Path) -> None:
    found, source = read(write_carmen(tmp_path / "a.log"))
    assert [type(m) for m in found] == [OdometryPose, OdometryPose, LaserScan] * 2
    assert [m.stamp for m in found] == [10.0, 10.25, 10.25, 10.5, 10.75, 10.75]
    np.testing.assert_array_equal(found[0].pose, [1.0, 2.0, 0.5])
    np.testing.assert_array_equal(found[1].pose, [1.5, -2.5, 0.75])
    np.testing.assert_array_equal(found[2].ranges, CARMEN_RANGES)
    assert math.isnan(found[2].range_max)
    assert not source.problems.counts


@pytest.mark.parametrize(
    ("n", "first", "last"), [(180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90)]
)
def test_beams_of_a_sick(tmp_path: Path, n: int, first: float, last: float) -> None:
    found, source = read(log(tmp_path, flaser(1.0, [1.0] * n)))
    angles = np.degrees(found[1].angles)
    np.testing.assert_allclose(angles, np.linspace(first, last, n), atol=1e-12)
    assert not source.problems.counts


def test_unusual_beam_counts_are_reported(tmp_path: Path) -> None:
    path = log(tmp_path, flaser(1.0, [1.0] * 541))
    found, source = read(path)
    np.testing.assert_allclose(np.degrees(found[1].angles[[0, -1]]), [-90.0, 90.0])
    assert source.problems.counts == {"guessed beam angles": 1}
    found, _ = read(path, field_of_view=math.radians(270.0))
    np.testing.assert_allclose(np.degrees(found[1].angles[:2]), [-135.0, -134.5])


def test_robot_laser_lines_contain_their_angles(tmp_path: Path) -> None:
    path = log(tmp_path, robot_laser(1.0), robot_laser(2.0, 3, -1.0), robot_laser(3.0, 3, -1.0, 3))
    found, source = read(path)
    scans = [m for m in found if isinstance(m, LaserScan)]
    np.testing.assert_array_equal(scans[0].angles, [-1.5, -1.0, -0.5, 0.0])
    np.testing.assert_array_equal(scans[1].angles, [-1.0, -0.5, 0.0])
    np.testing.assert_array_equal(scans[2].ranges, [0.5] * 3)
    assert [s.range_max for s in scans] == [81.9] * 3
    np.testing.assert_array_equal(found[0].pose, [1.0, 2.0, 0.5])
    assert not source.problems.counts


def test_raw_laser_lines_have_no_pose(tmp_path: Path) -> None:
    path = log(tmp_path, odom(0.5), raw_laser(1.0), odom(1.5), raw_laser(2.0, 3, -1.0, 3))
    found, source = read(path)
    assert [type(m) for m in found] == [OdometryPose, LaserScan] * 2
    assert [m.stamp for m in found] == [0.5, 1.0, 1.5, 2.0]
    np.testing.assert_array_equal(found[3].angles, [-1.0, -0.5, 0.0])
    np.testing.assert_array_equal(found[3].ranges, [0.5] * 3)
    assert found[3].range_max == 81.9
    assert not source.problems.counts
    assert "scan RAWLASER1 (mount unknown" in choices(*open_log(path))
    assert {one.name: one.count for one in source.streams()} == {"ODOM": 2, "RAWLASER1": 2}


def test_robot_lasers_are_preferred_to_raw_ones(tmp_path: Path) -> None:
    found, _ = read(log(tmp_path, raw_laser(1.0), robot_laser(1.0), odom(1.5)))
    assert [type(m) for m in found] == [OdometryPose, LaserScan, OdometryPose]


def drive(mount=(0.22, -0.1, 0.3), *, slip: float = 0.0, turn: float = 0.1) -> list[str]:
    """ROBOTLASER1 lines of a robot on a curve, with its laser on a mount that moves by `slip` per line."""
    lines = []
    for k in range(20):
        robot = np.array([0.1 * k, 2.0, turn * k])
        laser = compose(robot, np.add(mount, [slip * k, 0.0, 0.0]))
        old = " 1.22 2 0.5 1 2 0.5 "
        new = " ".join(f"{value:.6f}" for value in (*laser, *robot))
        lines.append(robot_laser(1.0 + k).replace(old, f" {new} "))
    return lines


def test_the_poses_of_laser_and_robot_give_the_mount(tmp_path: Path) -> None:
    path = log(tmp_path, *drive())
    config, source = open_log(path)
    assert config.sensors["lidar"]["mount"] == (0.22, -0.1, 0.3)
    words = "scan ROBOTLASER1 (mount [0.220 m, -0.100 m, 17.2 deg], the poses in ROBOTLASER1)"
    assert choices(config, source) == f"{words}; odometry ODOM"
    config, _ = open_log(path, settings=["sensors.lidar.mount=[0.5,0,0]"])
    assert list(config.sensors["lidar"]["mount"]) == [0.5, 0, 0]


@pytest.mark.parametrize(
    "lines",
    [
        drive((0.0, 0.0, 0.0)),  # the robot's pose twice
        drive(slip=0.01),
        drive(turn=0.0),  # not turning, any two poses have a constant difference
        drive((50.0, 0.0, 0.0)),
        [robot_laser(1.0)],
        [flaser(1.0)],
        [line.replace("ROBOTLASER1", "FLASER") for line in drive()],
    ],
)
def test_poses_that_determine_no_mount(tmp_path: Path, lines: list[str]) -> None:
    config, source = open_log(log(tmp_path, *lines))
    assert "mount" not in config.sensors["lidar"]
    assert "mount unknown, assumed to be at base_link: not in the log" in choices(config, source)


def test_a_largest_range_of_zero_is_unset(tmp_path: Path) -> None:
    found, _ = read(log(tmp_path, robot_laser(1.0).replace(" 81.9 ", " 0 ")))
    assert [math.isnan(m.range_max) for m in found if isinstance(m, LaserScan)] == [True]


def test_the_rear_laser_is_left_out_by_default(tmp_path: Path) -> None:
    path = log(tmp_path, flaser(1.0, [2.0] * 180, "RLASER"), flaser(1.0))
    assert [len(read(path)[0]), len(read(path, laser="RLASER")[0])] == [2, 2]
    assert read(path)[0][1].ranges[0] == CARMEN_RANGES[0]
    assert read(path, laser="RLASER")[0][1].ranges[0] == 2.0
    used = {s.name: s.used for s in read(path)[1].streams()}
    assert used == {"ODOM": True, "FLASER": True, "RLASER": False}
    only = log(tmp_path, flaser(1.0, [2.0] * 180, "RLASER"))
    assert len(read(only)[0]) == 2


def test_a_wanted_rear_laser_is_a_separate_stream(tmp_path: Path) -> None:
    path = log(tmp_path, flaser(1.0), flaser(1.5, [2.0] * 180, "RLASER"), flaser(2.0), odom(2.5))
    alone = read(path)[0]
    with recognise(path)(path=path, wanted=("RLASER",)) as source:
        (batch,) = source.batches()
        shown = {s.name: (s.used, s.default, s.count) for s in source.streams()}
        assert source.defaults() == {OdometryPose: "ODOM", LaserScan: "FLASER"}
    assert {name: c.stamps.tolist() for name, c in batch.items()} == {
        "ODOM": [1.0, 2.0, 2.5],
        "FLASER": [1.0, 2.0],
        "RLASER": [1.5],
    }
    assert batch["RLASER"]["ranges"][0, 0] == 2.0
    assert shown == {"ODOM": (True, True, 3), "FLASER": (True, True, 2), "RLASER": (True, False, 1)}
    assert [m.stamp for m in alone] == [1.0, 1.0, 2.0, 2.0, 2.5]


def test_an_unusable_wanted_stream_is_an_error(tmp_path: Path) -> None:
    path = log(tmp_path, "PARAM robot_length 0.5 nohost 0", flaser(1.0))
    with (
        recognise(path)(path=path, wanted=("PARAM",)) as source,
        pytest.raises(SourceError, match="mapping cannot use stream 'PARAM' of type text"),
    ):
        next(source.batches())


def test_gzip_reads_like_plain_text(tmp_path: Path) -> None:
    plain = write_carmen(tmp_path / "a.log")
    packed = tmp_path / "b"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert len(read(packed)[0]) == len(read(plain)[0])


def test_a_truncated_gzip_file_is_read_to_its_end(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.log.gz"
    text = "\n".join(flaser(float(i), rng.random(180)) for i in range(300))
    path.write_bytes(gzip.compress(text.encode())[:-1000])
    found, source = read(path)
    assert source.problems.counts == {"damaged file": 1}
    assert 400 < len(found) < 600


@pytest.mark.parametrize(
    "bad",
    [
        "FLASER 180 1.0 2.0",
        "FLASER x 1.0 2.0",
        "FLASER",
        "FLASER 0 0 0 0 0 0 0 1.0 host 0",
        flaser(1.0).replace("1.5 -2.5", "nan -2.5"),
        flaser(1.0).replace("1.000000", "inf"),
        flaser(1.0).replace("0.25 0.5", "0.25 0.5x"),
        "ODOM 1 2 3",
        "ODOM 1 2 nan 0 0 0 1.0 host 0",
        "ODOM 1 2 three 0 0 0 1.0 host 0",
        "ODOM 1 2 3 0 0 0 1e999 host 0",
        "\x00\x01 binary",
    ],
)
def test_bad_lines_are_reported_with_their_place_and_dropped(tmp_path: Path, bad: str) -> None:
    path = log(tmp_path, odom(0.0), flaser(0.5), bad, flaser(1.0))
    path.write_text(path.read_text())
    found, source = read_directly(path)
    assert len(found) == 5
    assert sum(source.problems.counts.values()) == 1
    (example,) = source.problems.examples.values()
    assert example.startswith(f"{path}:3: ")


def read_directly(path: Path) -> tuple[list, object]:
    from impslam.sources.carmen import Carmen  # noqa: PLC0415  # NUL keeps it from recognition

    with Carmen(path=path) as source:
        return list(messages(source.batches())), source


def test_bad_raw_lasers(tmp_path: Path) -> None:
    good = raw_laser(1.0, remissions=2)
    bad = [good + " 7", good.replace("-1.5", "nan"), good.rsplit(" ", 2)[0], "RAWLASER1 0 -1.5"]
    found, source = read(log(tmp_path, good, *bad, raw_laser(2.0)))
    assert len(found) == 2
    assert source.problems.counts == {"malformed RAWLASER1": 4}


def test_bad_robot_lasers(tmp_path: Path) -> None:
    good = robot_laser(1.0)
    bad = [
        good.replace("81.9", "81.9 7"),
        good.replace("-1.5", "nan"),
        good.replace(" 4 ", " -4 "),
        good.rsplit(" ", 5)[0],
        robot_laser(1.0, remissions=2).replace(" 2 7 7 ", " 200 7 7 "),
    ]
    found, source = read(log(tmp_path, good, *bad, robot_laser(2.0)))
    assert len(found) == 4
    assert source.problems.counts == {"malformed ROBOTLASER1": 5}


def test_lines_read_as_tables_equal_those_read_one_by_one(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = []
    for i in range(120):
        sound = [
            odom(0.1 * i, float(rng.normal())),
            flaser(0.1 * i, rng.random(rng.choice([7, 180])).round(3)),
            flaser(0.1 * i, [2.0] * 9, "RLASER"),
            robot_laser(0.1 * i, start=-1.5 + 0.1 * (i % 4), remissions=i % 3),
            raw_laser(0.1 * i, start=-1.5 + 0.1 * (i % 4), remissions=i % 3),
            " " + odom(0.1 * i),
            flaser(0.1 * i, [1e-7, math.nan, 1e400, *rng.random(177)]),
            odom(0.1 * i).replace(" ", "\t"),
        ][rng.integers(8)]
        words = sound.split(" ")
        words[rng.integers(len(words))] = ["x", "nan", "", "-1", "1e", "7 7"][rng.integers(6)]
        lines.append(" ".join(words) if i % 4 == 0 else sound)
    path = log(tmp_path, *lines)
    for choice in ("FLASER", "ROBOTLASER1", "RAWLASER1"):
        found, source = read(path, laser=choice, wanted=("RLASER",))
        with monkeypatch.context() as patched:
            patched.setattr(carmen, "shapes", lambda *_: ())
            expected, slow = read(path, laser=choice, wanted=("RLASER",))
        assert len(found) == len(expected) > 50
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
        assert source.problems == slow.problems
        assert len(source.problems.counts) > 2


def test_odd_ranges_are_passed_on_to_the_lidar(tmp_path: Path) -> None:
    ranges = [math.nan, -1.0, 0.0, 81.83, math.inf, *[1.0] * 175]
    found, source = read(log(tmp_path, flaser(1.0, ranges)))
    np.testing.assert_array_equal(found[1].ranges, ranges)
    assert not source.problems.counts


def test_repeated_and_backward_stamps_and_gaps_are_counted(tmp_path: Path) -> None:
    stamps = [1.0, 2.0, 2.0, 1.5, 200.0]
    found, source = read(log(tmp_path, *map(odom, stamps)))
    assert [m.stamp for m in found] == stamps
    assert source.problems.counts == {"repeated stamp": 1, "backward stamp": 1, "gap": 1}
    assert ":5: ODOM was silent for 198.5 s" in source.problems.examples["gap"]


def test_stamps_of_odometry_and_laser_lines_are_checked_separately(tmp_path: Path) -> None:
    found, source = read(log(tmp_path, odom(1.0), flaser(0.9), odom(1.1), flaser(1.0)))
    assert len(found) == 6
    assert not source.problems.counts


def test_position_runs_to_the_total(tmp_path: Path) -> None:
    from impslam.sources.carmen import Carmen  # noqa: PLC0415

    path = log(tmp_path, *(flaser(float(i)) for i in range(200)))
    with Carmen(path=path) as source:
        steps = [source.position for _ in messages(source.batches(1))]
        assert source.position == source.total == path.stat().st_size
    assert steps == sorted(steps)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "scans", "poses", "odd"),
    [
        ("intel/intel.log", 13631, 13631 + 26915, {"backward stamp"}),
        ("fr079/fr079.log", 4934, 4934 + 8951, set()),
        ("fr-hospital/fr-hospital.log", 6917, 6917, {"gap"}),
        ("fr101/fr101.recovered.log", 292, 292 + 4277, {"gap"}),
    ],
)
def test_real_logs(data_folder: Path, name: str, scans: int, poses: int, odd: set[str]) -> None:
    begin = time.perf_counter()
    found, source = read(data_folder / name)
    assert time.perf_counter() - begin < 10.0  # s; 0.6 on an idle core
    assert source.preset == "default"
    assert sum(isinstance(m, LaserScan) for m in found) == scans
    assert sum(isinstance(m, OdometryPose) for m in found) == poses
    assert set(source.problems.counts) == odd


@pytest.mark.real
@pytest.mark.parametrize("name", ["intel/intel", "fr079/fr079", "fr-hospital/fr-hospital"])
def test_relations_name_scans_by_their_stamps(data_folder: Path, name: str) -> None:
    found, _ = read(data_folder / f"{name}.log")
    stamps = {m.stamp for m in found if isinstance(m, LaserScan)}
    lines = (data_folder / f"{name}.relations").read_text().splitlines()
    pairs = [line.split()[:2] for line in lines if line and not line.startswith("#")]
    assert len(pairs) > 1000
    assert {float(stamp) for pair in pairs for stamp in pair} <= stamps


@pytest.mark.real
def test_hospital_scans_start_at_four_angles(data_folder: Path) -> None:
    found, _ = read(data_folder / "fr-hospital" / "fr-hospital.log")
    starts = {round(math.degrees(m.angles[0]), 2) for m in found if isinstance(m, LaserScan)}
    assert starts == {-90.0, -89.75, -89.5, -89.25}
