"""`imp tune`: a config with its evidence, from a few runs."""

import csv

import pytest

from impslam.config import load
from impslam.paths import exclusive

pytest.importorskip("optuna")


def test_a_search_writes_a_config_and_its_evidence(imp, room, tmp_path):
    words = ["tune", room, "--holdout", "room", "--score", "likelihood", "--jobs", 1]
    words += ["--search", "sensors.lidar.sigma=0.001:0.1", "-c", tmp_path / "mine.toml"]
    words += ["-o", tmp_path / "out"]
    (tmp_path / "mine.toml").write_text('base = "imp"\n')
    said = imp(*words, "--trials", 3)
    assert said.code == 0, said.err
    config = load(tmp_path / "out" / "tuned.toml")
    assert 'base = "../mine.toml"' in (tmp_path / "out" / "tuned.toml").read_text("utf-8")
    assert 0.001 <= config.sensors["lidar"]["sigma"] <= 0.1
    assert "room, held out: " in said.out
    with (tmp_path / "out" / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["log"], row["config"]) for row in rows} == {
        (log, when) for log in (str(room), "room") for when in ("before", "after")
    }
    assert (tmp_path / "out" / "search.png").read_bytes().startswith(b"\x89PNG")
    assert imp(*words, "--trials", 3, "--quiet").code == 0  # goes on, with nothing left to try


@pytest.mark.parametrize("command", [["sweep"], ["tune", "--search", "filter.kind=ekf,riekf"]])
def test_two_commands_do_not_write_to_one_folder(imp, tmp_path, command):
    name, *more = command
    with exclusive(tmp_path):
        said = imp(name, "room", *more, "-o", tmp_path)
    assert said.code == 2
    assert said.err == (
        f"imp: error: {tmp_path}: another process writes to it; wait for its end, or give another -o\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "no log given"),
        (("room", "--trials", "0"), "--trials and --seeds: must be at least 1"),
        (("room", "--search", "filter.knd=a,b"), "knd is not a parameter"),
        (("room", "--holdout", "room"), "room: named as a log to tune on and with --holdout"),
        (("room", "-c", "kf-demo", "--search", "seed=1"), "expected LOW:HIGH"),
    ],
)
def test_unusable_searches_are_one_line_errors(imp, tmp_path, words, message):
    said = imp("tune", *words, "-o", tmp_path / "out")
    assert said.code == 2
    assert message in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "out").exists()
