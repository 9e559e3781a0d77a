"""`imp sweep`: one table of many runs, which goes on where it was left."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A room in which the robot drives for three seconds."""
    from importlib.resources import files  # noqa: PLC0415

    text = (files("impslam.simulation") / "worlds" / "room.toml").read_text("utf-8")
    file = tmp_path_factory.mktemp("worlds") / "short.toml"
    file.write_text(text.replace("[robot]", "[robot]\nlimit = 3.0", 1))
    return file


def table(folder):
    with (folder / "runs.csv").open() as file:
        return list(csv.DictReader(file))


def test_logs_and_worlds_configs_settings_and_seeds(imp, world, room, tmp_path):
    words = ["sweep", world, room, "-c", "imp", "--set", "filter.kind=ekf,riekf", "--jobs", 1]
    said = imp(*words, "-o", tmp_path / "out")
    assert said.code == 0, said.err
    rows = table(tmp_path / "out")
    assert [(Path(r["log"]).name, r["filter.kind"]) for r in rows] == [
        *(
            ("room.mcap", "ekf"),
            ("room.mcap", "riekf"),
            ("short.toml", "ekf"),
            ("short.toml", "riekf"),
        )
    ]
    assert {r["status"] for r in rows} == {"ok"}
    for r in rows:
        assert 0.0 < float(r["ate_m"]) < 0.05
        assert "disagreement_m" in r
        assert float(r["nees_per_dof"]) > 0.0
        assert float(r["tracking"]) == 1.0
        assert float(r["cpu_s"]) > 0.0
        assert r["landmarks_missing"]
    assert (tmp_path / "out" / "errors.png").read_bytes().startswith(b"\x89PNG")
    assert "filter.kind=riekf" in said.out


def test_a_sweep_continues_and_a_failed_run_is_a_row(imp, world, tmp_path):
    bad = tmp_path / "blind.log"
    bad.write_text("ODOM 0.0 0.0 0.0 0.0 0.0 0.0 1.0 host 1.0\n" * 2)
    words = ["sweep", world, bad, "-o", tmp_path / "out", "--jobs", 1]
    assert imp(*words).code == 0
    good, failed = sorted(table(tmp_path / "out"), key=lambda r: r["status"], reverse=True)
    assert good["status"] == "ok"
    assert failed["status"] == "failed"
    assert "no usable scan" in failed["message"]
    said = imp(*words, "--seeds", 2)
    assert "1 of 4 runs are already done" in said.out
    assert sorted((r["status"], r["seed"]) for r in table(tmp_path / "out")) == [
        *(("failed", "0"), ("failed", "1"), ("ok", "0"), ("ok", "1"))
    ]


def test_ctrl_c_keeps_what_is_done(world, tmp_path):
    words = ["sweep", str(world), "--seeds", "1000", "--jobs", "2", "-o", str(tmp_path / "out")]
    code = f"import sys; from impslam.cli import main; sys.exit(main({words!r}))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    journal, end = tmp_path / "out" / "runs.jsonl", time.monotonic() + 60.0
    while time.monotonic() < end and not (journal.exists() and journal.stat().st_size):
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said == "imp: interrupted\n"
    kept = [json.loads(line) for line in journal.read_text().splitlines()]
    assert len(table(tmp_path / "out")) == len(kept) >= 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "no log given"),
        (("nowhere.log",), "nowhere.log: no such file or folder"),
        (("room", "--seeds", "0"), "--seeds 0: must be at least 1"),
        (("room", "--jobs", "0"), "--jobs 0: must be at least 1"),
        (("room", "--set", "filter.knd=ekf"), "knd is not a parameter"),
        (("room", "arena", "--truth", "t.tum"), "--truth t.tum: does not name its log"),
        (("room", "--set", "seed=1,2"), "seed: each run has its own one"),
        (("room", "--truth", "hall=t.tum"), "hall is not one of the logs room"),
        (("room", "--truth", "t.tum"), "drives in a world have their own truth; leave out t.tum"),
        (("room", "--relations", "r.txt"), "leave out r.txt"),
        (("room", "-j", "1", "--scheduler", "tcp://x:1"), "--jobs and --scheduler: give only one"),
    ],
)
def test_unusable_arguments_are_one_line_errors(imp, tmp_path, words, message):
    said = imp("sweep", *words, "-o", tmp_path / "out")
    assert said.code == 2
    assert message in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "out").exists()
