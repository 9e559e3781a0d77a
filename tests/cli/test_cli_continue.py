"""`imp run LOG --map FILE`: which maps it continues, and which it rejects."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from impslam.cli import main
from impslam.map import Map

GRAPH = ("--set", "estimator.kind=graph", "--set", "tracker.kind=scan_to_map")


@pytest.fixture(scope="module")
def done(room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the room."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    assert main(["run", str(room), "-o", str(folder), "--quiet", *GRAPH]) == 0
    return folder


def test_a_log_that_is_already_in_the_map_is_rejected(imp, room, done, tmp_path) -> None:
    said = imp("run", room, *GRAPH, "--map", done / "map.imp", "-o", tmp_path / "again")
    assert said.code == 2
    assert "all of its 100 scans are in the map already" in said.err
    assert not (tmp_path / "again").exists()


def test_a_log_that_was_mapped_before_another_one_is_rejected(imp, room, done, tmp_path) -> None:
    known = Map.load(done / "map.imp")
    (first,) = known.about["logs"]
    logs = [{**first, "scans": 60}, {"log": "later.mcap", "log_sha256": "ab", "scans": 40}]
    file = replace(known, about={**known.about, "logs": logs}).save(tmp_path / "two.imp")
    said = imp("run", room, *GRAPH, "--map", file, "-o", tmp_path / "again")
    assert said.code == 2
    assert f"{room}: 60 scans of it are in the map already; give another log" in said.err
    assert not (tmp_path / "again").exists()


def test_a_log_that_is_not_found_in_a_frozen_map_is_an_error(imp, room, done, tmp_path) -> None:
    """The room is too small to drive the way that it takes to be found."""
    said = imp("run", room, *GRAPH, "--map", done / "map.imp", "--frozen", "-o", tmp_path / "there")
    assert said.code == 2
    assert "could not be located in the map" in said.err
    assert not (tmp_path / "there").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--frozen"], "--frozen and --start need a map; give one with --map FILE"),
        (["--start", "1,2"], "give one with --map FILE"),
        (["--map", "gone.imp"], "gone.imp: no such file"),
        (["--map", "MAP", "--start", "1"], "--start 1: not a pose; give x,y"),
        (["--start", "-1,-2"], "give one with --map FILE"),
        (["--start", "-1,2,-0.5"], "give one with --map FILE"),
        (["--map", "MAP", "--start", "0,0,180"], "theta is in rad; 180 deg is 3.1416"),
        (["--map", "MAP", "--start", "--frozen"], "--start --frozen: not a pose; give x,y"),
        (["--map", "MAP", "--start", "1,nan"], "--start 1,nan: not a pose"),
        (["--map", "MAP", "--live"], "leave out --live or --map"),
        (["--map", "MAP", "--set", "estimator.kind=landmarks"], "cannot continue a map"),
    ],
)
def test_an_unusable_map_or_start_is_rejected(imp, room, done, tmp_path, words, said) -> None:
    given = [str(done / "map.imp") if word == "MAP" else word for word in words]
    ended = imp("run", room, *given, "-o", tmp_path / "none")
    assert ended.code == 2
    assert said in ended.err
    assert ended.err.count("\n") == 1
    assert not (tmp_path / "none").exists()


def test_the_map_lists_its_logs(done) -> None:
    (log,) = Map.load(done / "map.imp").about["logs"]
    sha256 = json.loads((done / "summary.json").read_text())["log"]["sha256"]
    assert log == {"log": "room.mcap", "log_sha256": sha256, "scans": 100}
