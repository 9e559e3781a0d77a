"""`imp map`: commands on a map's file, with good input and bad."""

from __future__ import annotations

import csv
import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.g2o import read_g2o
from tests.extractors.scans import room
from tests.maps.drawn import mapped
from tests.recognition.plans import OFFICE, way

from impslam.evaluation.tum import read_tum
from impslam.imported_map import read_grid
from impslam.map import Map
from impslam.observers.map_files import MAP_FILES
from impslam.run import run


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of an office's map, askew by 0.2 rad."""
    folder = tmp_path_factory.mktemp("office")
    return mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2, 20), T=(1.0, 2.0, 0.2)).save(folder / "a.imp")


def test_info_prints_the_facts_and_draws_the_map(imp, office, tmp_path) -> None:
    said = imp("map", "info", office, "--json", tmp_path / "facts.json")
    assert said.code == 0, said.err
    assert "40 scans, 20 keyframes" in said.out
    assert "99 % within 5° of +11." in said.out
    assert "drawn" in said.out
    assert office.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["motions"] == 19
    assert facts["closures"] == 0
    assert facts["age_s"] is None  # its stamps are no Unix time
    assert 40.0 < facts["free_m2"] < 190.0
    assert (facts["first_s"], facts["last_s"]) == (0.0, 19.5)
    assert facts["direction"]["angle_rad"] == pytest.approx(0.2, abs=0.01)
    described = (Path(__file__).parents[2] / "docs/maps.md").read_text("utf-8")
    names = [*facts, *facts["direction"], *facts["quality"]]
    assert [name for name in names if f"`{name}`" not in described] == []


def test_info_reports_unplaced_keyframes(imp, office, tmp_path) -> None:
    known = Map.load(office)
    sessions = np.repeat([0, 1], 10)
    rows = replace(known.keyframes, sessions=sessions, placed=sessions == 0)
    file = replace(known, keyframes=rows).save(tmp_path / "lost.imp")
    assert "20 keyframes, 10 of them not placed in the map" in imp("map", "info", file).out


def test_info_draws_to_the_given_file(imp, office, tmp_path) -> None:
    assert imp("map", "info", office, "-o", tmp_path / "b.png", "--quiet").out == ""
    assert (tmp_path / "b.png").exists()


def test_straighten_turns_the_map(imp, office, tmp_path) -> None:
    said = imp("map", "straighten", office, "-o", tmp_path / "straight.imp")
    assert said.code == 0, said.err
    assert "turned by  -11.4" in said.out or "turned by  -11.5" in said.out
    straight = Map.load(tmp_path / "straight.imp")
    assert abs(straight.direction().angle) < 1e-3


def test_export_writes_what_other_programs_read(imp, office, tmp_path) -> None:
    folder = tmp_path / "out"
    for resolution in ("0.05", "0.1"):  # the second time over the first
        said = imp("map", "export", office, "-o", folder, "--resolution", resolution)
        assert said.code == 0, said.err
        assert str(folder / "map.pgm") in said.out
    known = Map.load(office)
    np.testing.assert_allclose(read_tum(folder / "trajectory.tum"), known.path(), atol=1e-6)
    header = (folder / "trajectory.csv").read_text().splitlines()[0]
    assert header.startswith("stamp,x,y,theta,")
    assert "health" not in header  # a map does not contain it
    assert len(read_g2o(folder / "graph.g2o").edges.i) == 19
    assert read_grid(folder / "map.yaml").resolution == 0.1


def test_an_export_that_fails_leaves_the_earlier_one(imp, office, tmp_path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = tmp_path / "out"
    assert imp("map", "export", office, "-o", folder).code == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr("impslam.observers.map_files.write_map", full)
    for output in (folder, tmp_path / "new"):
        said = imp("map", "export", office, "-o", output, "--resolution", "0.1")
        assert said.code == 2
        assert f"{output}: cannot be written (No space" in said.err
        assert said.err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert not (tmp_path / "new").exists()


def test_an_export_leaves_a_folder_with_other_files_as_it_is(imp, office, tmp_path) -> None:
    folder = tmp_path / "out"
    (folder / ".part").mkdir(parents=True)
    for name in (".part/precious", "other"):
        (folder / name).write_text("mine")
    said = imp("map", "export", office, "-o", folder)
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "contains 'other', which this command does not write" in said.err
    assert {path.name for path in folder.rglob("*")} == {".part", "precious", "other"}


def test_an_export_removes_what_a_killed_one_left(imp, office, tmp_path) -> None:
    folder = tmp_path / "out"
    (folder / ".part").mkdir(parents=True)
    (folder / ".part" / "trajectory.csv").write_text("half a li")
    assert imp("map", "export", office, "-o", folder).code == 0
    assert {path.name for path in folder.iterdir()} == MAP_FILES


POST, MOVED = np.array([[-6.0, -0.6, 0.15]]), np.array([[5.0, 0.3, 0.15]])
DRIVE = np.concatenate([way(-7.0, 0.3, 8.0, 0.2, 30), way(8.0, -0.5, -7.0, -0.9, 30)])


def test_diff_aligns_the_maps_and_finds_changes(imp, tmp_path) -> None:
    before = mapped(OFFICE, DRIVE, POST).save(tmp_path / "before.imp")
    later = mapped(OFFICE, DRIVE[::-1], MOVED, T=(3.0, 1.0, 2.0), seed=1)
    after = later.save(tmp_path / "after.imp")
    said = imp(
        "map", "diff", before, after, "-o", tmp_path / "d.png", "--json", tmp_path / "d.json"
    )
    assert said.code == 0, said.err
    facts = json.loads((tmp_path / "d.json").read_text())
    (gone,), (new,) = facts["gone"], facts["new"]
    np.testing.assert_allclose(gone["position_m"], POST[0, :2], atol=0.2)
    np.testing.assert_allclose(new["position_m"], MOVED[0, :2], atol=0.2)
    assert "gone" in said.out
    assert "new" in said.out
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")


def test_diff_of_one_map_is_nothing(imp, office) -> None:
    assert "nothing has changed" in imp("map", "diff", office, office, "--aligned").out


def test_diff_of_two_buildings_is_refused(imp, office, tmp_path) -> None:
    hall = mapped(room(0, 9, 0, 7), way(1, 1, 8, 5, 30)).save(tmp_path / "hall.imp")
    said = imp("map", "diff", office, hall)
    assert said.code == 2
    assert f"{hall} in {office}" in said.err
    assert said.err.count("\n") == 1


def test_merge_joins_maps_of_several_drives(imp, office, tmp_path) -> None:
    other = mapped(OFFICE, DRIVE, T=(30.0, 9.0, -2.0), seed=3).save(tmp_path / "other.imp")
    said = imp("map", "merge", office, other, "-o", tmp_path / "both.imp")
    assert said.code == 0, said.err
    assert "2 maps, joined by" in said.out
    both = Map.load(tmp_path / "both.imp")
    parts = len(Map.load(office).landmarks) + len(Map.load(tmp_path / "other.imp").landmarks)
    assert f"landmarks  {len(both.landmarks)}, merged from {parts}\n" in said.out
    assert len(both.keyframes) == 20 + len(DRIVE)
    assert "made from  drawn, drawn" in imp("map", "info", tmp_path / "both.imp").out


def test_merge_names_the_map_that_does_not_fit(imp, office, tmp_path) -> None:
    hall = mapped(room(0, 9, 0, 7), way(1, 1, 8, 5, 30)).save(tmp_path / "hall.imp")
    said = imp("map", "merge", office, hall, "-o", tmp_path / "both.imp")
    assert said.code == 2
    assert said.err.startswith(
        f"imp: error: {hall}: cannot be merged: they have no place in common"
    )
    assert said.err.count("\n") == 1
    assert not (tmp_path / "both.imp").exists()


def test_merge_names_the_log_that_two_maps_contain(imp, lived_in, tmp_path) -> None:
    said = imp("map", "merge", lived_in, lived_in, "-o", tmp_path / "both.imp")
    assert said.code == 2
    assert f"{lived_in} and {lived_in} both contain the log room.mcap, whose scans" in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "both.imp").exists()


@pytest.fixture(scope="module")
def lived_in(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map's file of a drive through a small room."""
    return run(room, "imp").save(tmp_path_factory.mktemp("lived") / "room.imp")


def test_localise_locates_each_scan(imp, room, lived_in, tmp_path) -> None:
    folder = tmp_path / "places"
    said = imp("map", "localise", lived_in, room, "-c", "imp", "--every", "8", "-o", folder)
    assert said.code == 0, said.err
    path = {row[0]: row[1:] for row in Map.load(lived_in).path()}
    with (folder / "places.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == -(-len(path) // 8)
    found = [row for row in rows if row["verdict"] == "found"]
    assert len(found) > len(rows) / 2
    for row in found:
        true = min(path.items(), key=lambda item: abs(item[0] - float(row["stamp"])))[1]
        assert np.hypot(float(row["x"]) - true[0], float(row["y"]) - true[1]) < 0.05
        assert 0.98 <= float(row["probability"]) <= 1.0
    facts = json.loads((folder / "summary.json").read_text())
    assert facts["found"] == len(found)
    assert f"{len(found)} of {len(rows)} scans" in said.out
    assert (folder / "places.png").read_bytes().startswith(b"\x89PNG")


def test_a_missing_log_is_a_one_line_error(imp, office, tmp_path) -> None:
    said = imp("map", "localise", office, tmp_path / "none.mcap", "-o", tmp_path / "p")
    assert said.code == 2
    assert "none.mcap" in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "p").exists()


ROUND = np.stack([4.0 * np.column_stack([np.cos(t), np.sin(t)]) for t in (
    2.0 * np.pi * np.arange(60) / 60, 2.0 * np.pi * np.arange(1, 61) / 60)], axis=1)  # fmt: skip


def test_a_round_hall_is_not_straightened(imp, tmp_path) -> None:
    file = mapped(ROUND, way(-1, 0, 1, 0.5, 4)).save(tmp_path / "round.imp")
    said = imp("map", "straighten", file, "-o", tmp_path / "straight.imp")
    assert said.code == 2
    assert f"{file}: the walls have no main direction" in said.err
    assert not (tmp_path / "straight.imp").exists()


@pytest.mark.parametrize(
    ("command", "more"),
    [
        ("info", ()),
        ("straighten", ("-o", "x.imp")),
        ("export", ("-o", "x")),
        ("diff", ("y.imp",)),
        ("merge", ("y.imp", "-o", "x.imp")),
        ("localise", ("y.log",)),
    ],
)
def test_files_that_are_no_maps_are_one_line_errors(imp, office, tmp_path, command, more) -> None:
    damaged = tmp_path / "damaged.imp"
    damaged.write_bytes(office.read_bytes()[:5000])
    text = tmp_path / "text.imp"
    text.write_text("no map")
    for file, why in (
        (tmp_path / "none.imp", "no such file"),
        (damaged, "damaged"),
        (text, "not a map"),
    ):
        said = imp("map", command, file, *more)
        assert said.code == 2
        assert said.err.startswith(f"imp: error: {file}: ")
        assert why in said.err
        assert said.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("info", "MAP", "-o", "map.jpg"), "pictures are written as PNG"),
        (("info", "MAP", "-o", "/nowhere/map.png"), "cannot be written"),
        (("straighten", "MAP"), "output"),
        (("straighten", "MAP", "-o", "/nowhere/map.imp"), "cannot be written"),
        (("export", "MAP", "-o", "FOLDER"), "contains 'mine.txt', which"),
        (("export", "MAP", "-o", "MAP"), "MAP"),
        (("export", "MAP", "-o", "new", "--resolution", "0"), "resolution"),
        (("merge", "MAP", "-o", "new.imp"), "two or more maps"),
        (("straighten", "MAP", "-o", "new.txt"), "new.txt: the file name must end in .imp"),
        (("merge", "MAP", "MAP"), "output"),
        (("turn", "MAP"), "turn"),
    ],
)  # fmt: skip
def test_unusable_arguments_are_one_line_errors(
    imp, office, tmp_path, monkeypatch, words, why
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine.txt").write_text("")
    names = {"MAP": str(office), "FOLDER": str(tmp_path / "folder")}
    said = imp("map", *(names.get(word, word) for word in words))
    assert said.code == 2
    assert names.get(why, why) in said.err
    assert said.err.count("\n") == 1
    assert (tmp_path / "folder" / "mine.txt").exists()
