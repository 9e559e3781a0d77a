"""A folder that is no log: an error says which logs it contains and what to do."""

import os
from pathlib import Path

import pytest
from tests.sources.bags import ROS1, ROS2, bag, odometry, scan
from tests.sources.logs import read

from impslam.errors import SourceError
from impslam.sources.base import recognise
from impslam.sources.rosbag import RosBag
from impslam.types import LaserScan

CARMEN = "FLASER 3 1.0 2.0 3.0 0 0 0 0 0 0 1.0 host 1.0\n"


def refusal(folder: Path) -> str:
    with pytest.raises(SourceError) as error:
        recognise(folder)
    said = str(error.value)
    assert "\n" not in said
    return said


def test_the_logs_in_a_folder_are_listed(tmp_path: Path) -> None:
    for name in ("b.log", "a.log"):
        (tmp_path / name).write_text(CARMEN)
    bag(tmp_path / "office", ("/scan", scan(ROS2)))
    (tmp_path / "notes.txt").write_text("hello\n")
    (tmp_path / "empty.log").touch()
    os.mkfifo(tmp_path / "pipe")
    said = refusal(tmp_path)
    assert "it contains 3 logs, a.log, b.log, office: give one of them" in said
    assert str(tmp_path / "a.log") in said
    assert "--map" in said


def test_a_single_log_in_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "only.log").write_text(CARMEN)
    assert f"it contains the log only.log: give {tmp_path / 'only.log'}" in refusal(tmp_path)


def test_of_many_logs_some_are_named(tmp_path: Path) -> None:
    for k in range(12):
        (tmp_path / f"{k:02}.log").write_text(CARMEN)
    said = refusal(tmp_path)
    assert "12 logs, 00.log, 01.log" in said
    assert "and 7 more" in said


def test_the_folder_of_a_run_is_told_from_one_of_logs(tmp_path: Path) -> None:
    for name in ("summary.json", "config.toml"):
        (tmp_path / name).touch()
    (tmp_path / "trajectory.csv").write_text("stamp,x,y,theta\n0,0,0,0\n")
    assert "the result of a run" in refusal(tmp_path)


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    assert refusal(tmp_path).endswith("the folder is empty; give a log, or the folder of one")


def test_a_folder_without_logs_is_of_no_known_format(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello\n")
    assert "no known log format; readable are" in refusal(tmp_path)


NAMES = ["drive_0", "drive_1", "drive_2"]
DATED = [f"2024-05-01-10-{k:02}-30_{k}" for k in (8, 9, 10)]


@pytest.mark.parametrize("names", [NAMES, [f"a_{name}" for name in DATED], DATED])
def test_the_pieces_of_a_split_bag_are_one_log(tmp_path: Path, names: list[str]) -> None:
    """`rosbag record --split` names each piece by the time at which it begins, and its number."""
    for k, name in enumerate(names):
        entries = [("/odom", odometry(ROS1))] if k == 0 else []
        scans = [("/scan", scan(ROS1, 5.0 * k + i)) for i in range(1, 6)]
        bag(tmp_path / f"{name}.bag", *entries, *scans, store=ROS1)
    found, source = read(tmp_path)
    stamps = [m.stamp for m in found if isinstance(m, LaserScan)]
    assert stamps == [float(k) for k in range(1, 16)]
    assert len(found) == 16
    assert not source.problems.counts
    with RosBag(path=tmp_path) as log:
        assert {stream.name: stream.count for stream in log.streams()} == {"/odom": 1, "/scan": 15}
        assert log.total == 16


@pytest.mark.parametrize("names", [["a_0", "b_1"], ["a", "b"], ["a_0", "a_00"]])
def test_other_bags_in_one_folder_are_separate_logs(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        bag(tmp_path / f"{name}.bag", ("/scan", scan(ROS1)), store=ROS1)
    assert "it contains 2 logs" in refusal(tmp_path)
