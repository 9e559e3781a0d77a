from __future__ import annotations

import json
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from impslam.cli import main
from impslam.cli.run_folder import RUN_FILES, run_folder
from impslam.sources.recording import McapWriter
from impslam.types import WheelAngles

WRITTEN = RUN_FILES - {"graph.g2o"}  # the preset of the room has no graph
SAME = sorted(WRITTEN - {"report.html", "report.png", "summary.json"})
"""Figures that are times stand in the others."""


@pytest.fixture(scope="module")
def done(room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the room."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    assert main(["run", str(room), "-o", str(folder), "--quiet", "--seed", "3"]) == 0
    return folder


def test_the_folder_is_complete(done) -> None:
    assert {path.name for path in done.iterdir()} == WRITTEN
    assert len(np.loadtxt(done / "trajectory.tum")) == 100


@pytest.mark.usefixtures("undiagnosed")
def test_true_landmarks_are_those_beside_the_log(imp, done, room, tmp_path) -> None:
    beside = room.with_name("room.landmarks.csv")
    assert (done / "truth.landmarks.csv").read_text() == beside.read_text()
    alone = shutil.copy(room, tmp_path)
    assert imp("run", alone, "-o", tmp_path / "run").code == 0
    assert not (tmp_path / "run" / "truth.landmarks.csv").exists()


def test_a_config_repeats_the_run_to_the_byte(imp, done, room, tmp_path) -> None:
    said = imp("run", room, "-c", done / "config.toml", "-o", tmp_path)
    assert said.code == 0, said.err
    for name in SAME:
        assert (tmp_path / name).read_bytes() == (done / name).read_bytes(), name
    assert json.loads((done / "summary.json").read_text())["seed"] == 3


def test_output(imp, room, tmp_path) -> None:
    said = imp("run", room, "-o", tmp_path)
    assert said.code == 0
    assert said.err == ""  # no progress bar where there is no terminal
    words = " ".join(said.out.split())
    assert "scans 100 used" in words
    assert "2 cylinders, 4 walls" in words
    assert "times real time" in words
    assert f"report: {tmp_path / 'report.html'}" in words


@pytest.mark.usefixtures("undiagnosed")
def test_output_of_loops_and_of_a_run_without_odometry(imp, room, tmp_path) -> None:
    alone = ("odometry.kind=lidar_only", "tracker.kind=scan_to_map", "estimator.kind=graph")
    said = imp("run", room, "-o", tmp_path, *(part for s in alone for part in ("--set", s)))
    assert said.code == 0, said.err
    assert "odometry   none, mapped by the lidar alone" in said.out
    assert re.search(r"^loops +0 closed, \d+ tried$", said.out, re.MULTILINE)
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert facts["lidar_alone"]
    assert facts["counts"]["loops closed"] == 0
    assert facts["time"]["stages_ms"]["refine"]["mean"] > 0.0
    report = (tmp_path / "report.html").read_text()
    assert "by the lidar alone" in report
    assert "<td>refine</td>" in report
    assert ">Loops<" in report


@pytest.mark.usefixtures("undiagnosed")
@pytest.mark.parametrize(("yaw", "is_told"), [(0.0, False), (0.2, True)])
def test_a_wrong_mount_is_told_with_the_command_that_measures_it(
    imp, room, tmp_path, yaw, is_told
) -> None:
    turned = "--set", f"sensors.lidar.mount=[0.15,0,{yaw}]", "--set", "tracker.kind=scan_to_map"
    said = imp("run", room, "-o", tmp_path, *turned)
    assert said.code == 0, said.err
    assert (f"fix: imp inspect {room}" in said.out) == is_told


def test_quiet(imp, room, tmp_path) -> None:
    assert imp("run", room, "-o", tmp_path, "--quiet").out == ""


@pytest.mark.usefixtures("undiagnosed")
def test_default_folder(imp, room, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # within a second, as like as not
        assert imp("run", room).code == 0
    folders = list((tmp_path / "runs").iterdir())
    assert len(folders) == 2
    assert all(folder.name.startswith("room-") for folder in folders)


def test_a_run_that_fails_leaves_no_folder(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with McapWriter(Path("a.mcap")) as writer:
        writer.write(WheelAngles(1.0, 0.0, 0.0))
    assert imp("run", "a.mcap").code == 2
    assert list((tmp_path / "runs").iterdir()) == []


def test_runs_started_at_the_same_time_get_separate_folders(tmp_path, monkeypatch) -> None:
    """Before either has written a file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "20260101-000000")
    with run_folder(None, "log") as first, run_folder(None, "log") as second:
        assert (first.name, second.name) == ("log-20260101-000000", "log-20260101-000000-2")


@pytest.mark.usefixtures("undiagnosed")
def test_settings_and_topics(imp, room, tmp_path) -> None:
    words = ["--set", "robot=other", "--set", "grid.resolution=0.1", "--topic", "imu="]
    assert imp("run", room, "-o", tmp_path, *words[:4], "--topic", "scan=/scan").code == 0
    config = (tmp_path / "config.toml").read_text()
    assert 'robot = "other"' in config
    assert "resolution = 0.1" in config
    assert 'scan = "/scan"' in config
    assert "resolution: 0.1" in (tmp_path / "map.yaml").read_text()


def test_dropped_messages_are_explained(imp, room, tmp_path) -> None:
    said = imp("run", room, "-o", tmp_path, "--set", "sensors.lidar.range_max=0.6")
    assert said.code == 0
    assert "problem: 84 x scan without valid beams: " in said.out
