from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from tests.estimators.drives import LAP, RING, way
from tests.evaluation.test_quality import keyframes, made

from impslam.cli import console
from impslam.cli.comparison_table import Cell, show
from impslam.evaluation.tum import PATH_COLUMNS, read_tum, write_tum
from impslam.geometry.se2 import compose
from impslam.maps.landmark_table import write_landmarks
from impslam.paths import short_names
from impslam.types import Landmark


def path(tmp_path, name, shift=(0.0, 0.0, 0.0)):
    t = np.arange(50.0)
    poses = compose(np.array(shift), np.column_stack((0.1 * t, np.sin(0.1 * t), 0.1 * t)))
    write_tum(tmp_path / name, np.column_stack((t, poses)))
    return tmp_path / name


def row(text: str, name: object) -> list[str]:
    """Return the figures in a run's row; long names are folded, so by their first word's line."""
    line = next(line for line in text.splitlines() if line.strip().startswith(str(name)[:20]))
    return line.split()[1:]


def test_against_truth(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "truth.tum")
    path(tmp_path, "same.tum")
    path(tmp_path, "off.tum", (0.3, 0.4, 0.0))
    said = imp("evaluate", "same.tum", "off.tum", "--truth", "truth.tum")
    assert said.code == 0, said.err
    assert row(said.out, "same.tum")[:4] == ["50", "0.0000", "0.0000", "0.0000"]
    assert row(said.out, "off.tum")[:4] == ["50", "0.5000", "0.0000", "0.0000"]


def test_the_poses_without_truth_are_counted(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "run.tum")
    write_tum(tmp_path / "truth.tum", read_tum(path(tmp_path, "whole.tum"))[:20])
    said = imp("evaluate", "run.tum", "--truth", "truth.tum")
    assert row(said.out, "run.tum")[0] == "20"
    lacking = "imp: warning: run.tum: the truth lacks 30 of 50 poses, which are not scored\n"
    assert said.err == lacking


def test_against_relations(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "line.tum")
    (tmp_path / "some.relations").write_text("0 0 0.03 0.04 0 0 0 0\n0 99 1 1 0 0 0 0\n")
    said = imp("evaluate", "line.tum", "--relations", "some.relations")
    assert said.code == 0, said.err
    figures = " ".join(row(said.out, "line.tum"))
    assert figures == "1 1 0.050 ± 0.000 0.050 0.00 ± 0.00 0.00"


def test_a_run_folder(imp, tmp_path) -> None:
    truth = path(tmp_path, "trajectory.tum")
    assert imp("evaluate", tmp_path, "--truth", truth).code == 0


def folder(tmp_path, name="run", shift=(0.0, 0.0, 0.0), truth=True):
    """Make a run folder with covariances, two landmarks and what its log told of the truth."""
    run = tmp_path / name
    run.mkdir(parents=True)
    rows = read_tum(path(run, "trajectory.tum", shift))
    spread = "1e-2,0,0,1e-2,0,1e-4"
    lines = [f"{','.join(f'{v:.9f}' for v in row)},{spread}" for row in rows]
    (run / "trajectory.csv").write_text("\n".join([PATH_COLUMNS, *lines]) + "\n")
    places = compose(np.array(shift), np.array([[1.0, 2.0, 0.0], [7.0, 7.0, 0.0]]))
    marks = [
        Landmark(i, "point", place[:2], {}, 0.01 * np.eye(2), None, 9, 0.0, 1.0)
        for i, place in enumerate(places)
    ]
    write_landmarks(run / "landmarks.csv", marks)
    if truth:
        path(run, "truth.tum")
        (run / "truth.landmarks.csv").write_text("name,x,y\nbush,1.1,2\ntree,-5,-5\n")
    return run


def test_a_run_folder_is_scored_against_its_own_truth(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder(tmp_path, "mine", shift=(4.0, 5.0, 1.0))
    said = imp("evaluate", "mine")
    assert said.code == 0, said.err
    figures = " ".join(row(said.out, "mine"))
    t, turn = np.arange(50.0), np.exp(1j)
    z = 0.1 * t + 1j * np.sin(0.1 * t)
    free = np.sqrt(np.mean(abs(turn * z + 4 + 5j - z) ** 2))
    assert figures.startswith(f"50 {free:.4f} 0.0000 0.0000 0.00 0.0000 0.000 0.00 ")
    assert figures.endswith(" 0 %")
    # kind, true, matched, missing, false, double, RMS, max, NEES
    marks = next(line for line in said.out.splitlines() if " point " in line).split()[1:]
    assert marks == ["point", "2", "1", "1", "1", "0", "0.1000", "0.1000", "1.00"]
    assert "its interval for consistent covariances and correlated poses" in " ".join(
        said.out.split()
    )
    assert "truth aligned with the map by the path's best fit" in said.out
    assert (
        said.out.count("NEES: mean over poses, with the truth aligned at the start, ideal 3") == 1
    )
    assert said.out.count("NEES: with the truth aligned at the start, ideal 2") == 1
    assert "poses unaligned, m ATE, m max, m" in " ".join(said.out.split())


def test_truth_landmarks_and_relations_together(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder(tmp_path, truth=False)
    path(tmp_path, "truth.tum")
    (tmp_path / "marks.csv").write_text("x,y\n1,2\n7,7.3\n")
    (tmp_path / "some.relations").write_text("0 0 0.03 0.04 0 0 0 0\n")
    given = ("--truth", "truth.tum", "--landmarks", "marks.csv", "--relations", "some.relations")
    said = imp("evaluate", "run", *given)
    assert said.code == 0, said.err
    assert "0.050 ± 0.000" in said.out
    assert " point      2         2 " in said.out
    strict = imp("evaluate", "run", *given, "--gate", "0.2")
    assert " point      2         1 " in strict.out
    alone = imp("evaluate", "run", "--landmarks", "marks.csv")
    assert "assuming that the truth is in the map frame" in alone.out
    assert " point      2         2 " in alone.out


def test_numbers_and_picture(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder(tmp_path, "a/run")
    folder(tmp_path, "b/run", shift=(0.3, 0.4, 0.0))
    said = imp("evaluate", "a/run", "b/run", "-o", "a.png", "--json", "a.json", "--align", "none")
    assert said.code == 0, said.err
    assert row(said.out, "b ")[:4] == ["50", "0.5000", "0.5000", "0.5000"]
    facts = json.loads((tmp_path / "a.json").read_text())
    assert (facts["align"], facts["delta_m"], facts["gate_m"]) == ("none", 1.0, 0.5)
    run = facts["runs"][str(Path("b/run"))]
    assert run["path"]["ate_m"]["rmse"] == pytest.approx(0.5)
    assert run["path"]["nees"]["mean"] == pytest.approx(25.0, rel=1e-6)
    assert run["landmarks"]["point"]["distance_m"]["count"] == 1
    assert run["landmarks"]["point"]["angle_rad"]["rmse"] == 0.0
    assert run["relations"] is None
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_truth_without_headings_is_noted(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = folder(tmp_path, "mine", shift=(1.0, 2.0, 0.5))
    rows = read_tum(run / "truth.tum")
    rows[:, 3] = np.nan
    write_tum(run / "truth.tum", rows)
    said = imp("evaluate", "mine", "--json", "a.json")
    assert said.code == 0, said.err
    assert row(said.out, "mine")[2:] == ["0.0000", "0.0000", *"------"]
    assert "the truth has positions only" in said.out
    assert json.loads((tmp_path / "a.json").read_text())["runs"]["mine"]["path"]["nees"] is None
    given = imp("evaluate", "mine", "--align", "none")
    assert "(2: position only)" in given.out
    assert "NEES: mean over poses, with the truth as given, ideal 2" in given.out
    assert "NEES: with the truth as given, ideal 2" in given.out
    assert "aligned at the start" not in given.out
    one_line(imp("evaluate", "mine", "--align", "start"), "no heading at the start of the run")


def test_runs_with_different_files_are_compared(imp, tmp_path, monkeypatch) -> None:
    """A bare trajectory beside a run folder has dashes and no row of landmarks."""
    monkeypatch.chdir(tmp_path)
    folder(tmp_path)
    path(tmp_path, "other.tum", (0.3, 0.4, 0.0))
    said = imp("evaluate", "run", "other.tum", "--truth", "run/truth.tum")
    assert said.code == 0, said.err
    assert row(said.out, "other.tum")[-2:] == ["-", "-"]
    assert said.out.count("other.tum") == 1


def test_a_simulated_run_is_scored_from_its_folder_alone(imp, room, tmp_path) -> None:
    assert imp("run", room, "-o", tmp_path / "room", "--quiet").code == 0
    alone = imp("evaluate", tmp_path / "room")
    assert alone.code == 0, alone.err
    beside = room.with_name("room.truth.tum"), room.with_name("room.landmarks.csv")
    given = imp("evaluate", tmp_path / "room", "--truth", beside[0], "--landmarks", beside[1])
    assert given.code == 0, given.err
    assert float(row(alone.out, "room")[2]) < 0.03
    assert row(alone.out, "room") == row(given.out, "room")
    assert " wall " in given.out


def test_a_truth_that_is_too_sparse_for_the_errors_is_a_warning(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    t = 0.1 * np.arange(300)
    circle = np.c_[t, np.cos(0.5 * t), np.sin(0.5 * t), 0.5 * t]
    write_tum(tmp_path / "run.tum", circle)
    for step, warned in ((10, True), (1, False)):
        write_tum(tmp_path / "truth.tum", circle[::step] + 1e-4)
        said = imp("evaluate", "run.tum", "--truth", "truth.tum")
        assert (
            "the truth has few poses: its linear interpolation is off by 0." in said.err
        ) is warned


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["runs/a"], ["a"]),
        (["."], ["."]),
        (["runs/a", "runs/b"], ["a", "b"]),
        (["a/trajectory.tum", "b/trajectory.tum"], ["a", "b"]),
        (["x/a/run", "x/b/c/run"], ["a", "b/c"]),
        (["a", "a/odometry.tum"], ["a", "a/odometry.tum"]),
        (["/r/a.tum", "/s/a.tum"], ["r", "s"]),
    ],
)
def test_names_are_what_differs(paths, names) -> None:
    assert short_names([Path(p) for p in paths]) == [str(Path(n)) for n in names]


def test_the_best_of_each_column_is_bold(monkeypatch, capsys) -> None:
    terminal = Console(force_terminal=True, color_system="standard", width=80)
    monkeypatch.setattr(console, "stdout", lambda: terminal)
    cells = {("a",): [Cell("1.5", 1.5), Cell("7"), Cell("-", math.nan), Cell("0.01", 0.011)]}
    cells[("b",)] = [Cell("0.5", 0.5), Cell("8"), Cell("0.3", 0.3), Cell("0.01", 0.012)]
    cells[("c",)] = [Cell("0.9", 0.9), Cell("9"), Cell("-", math.nan), Cell("0.02", 0.02)]
    show(["run", "p", "q", "r", "s"], cells)
    bold = re.findall(r"\x1b\[1m([^\x1b]+)\x1b", capsys.readouterr().out)
    assert [word.strip() for word in bold if "." in word] == ["0.01", "0.5", "0.01"]
    assert not {"7", "8", "9", "-"} & set(map(str.strip, bold))


def test_a_run_that_cannot_be_compared_is_left_out(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "good.tum")
    stamps = np.arange(5.0) + 1e6
    write_tum(tmp_path / "late.tum", np.column_stack((stamps, np.zeros((5, 3)))))
    said = imp("evaluate", "late.tum", "good.tum", "--truth", "good.tum")
    assert said.code == 0
    assert row(said.out, "good.tum")[:2] == ["50", "0.0000"]
    assert "left out: late.tum: the estimate" in said.err
    assert said.err.count("\n") == 1


def one_line(said, part) -> None:
    assert said.code == 2
    assert part in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--truth", "x"], "no run given"),
        (["good.tum", "--truth", "none.tum"], "none.tum: no such file"),
        (["none.tum", "--truth", "good.tum"], "none.tum: no such run"),
        (["."], "no trajectory.tum"),
        (["good.tum"], "good.tum: contains neither ground truth nor a map.imp; give --truth"),
        (["bad.tum", "--truth", "good.tum"], "bad.tum, line 1: expected stamp x y z"),
        (["good.tum", "--truth", "bad.tum"], "bad.tum, line 1: expected stamp x y z"),
        (["empty.tum", "--truth", "good.tum"], "empty.tum: contains no pose"),
        (["good.tum", "--truth", "empty.tum"], "empty.tum: contains no pose"),
        (["good.tum", "--truth", "late.tum"], "good.tum: the estimate"),
        (["good.tum", "--relations", "none"], "none: no such file"),
        (["good.tum", "--relations", "bad.tum"], "bad.tum, line 1: expected stamp1"),
        (["good.tum", "--relations", "empty.tum"], "contains no relation"),
        (["late.tum", "--relations", "good.relations"], "late.tum: no relation is within"),
        (["run", "--landmarks", "none.csv"], "none.csv: no such file"),
        (["run", "--landmarks", "empty.tum"], "contains no landmark"),
        (["run", "--landmarks", "bad.tum"], "bad.tum: contains no landmark"),
        (["good.tum", "--landmarks", "good.csv"], "good.tum: contains no landmarks.csv"),
        (["run", "--delta", "0"], "greater than 0"),
        (["run", "--gate", "nan"], "greater than 0"),
        (["run", "--align", "best"], "--align"),
        (
            ["picture.png"],
            "not a text file: it does not decode as UTF-8); give the folder of a run",
        ),
        (["run", "--truth", "picture.png"], "as UTF-8); give a TUM file"),
        (["run", "-o", "plot.jpg"], "plot.jpg: pictures are written as PNG"),
    ],
)
def test_one_line_errors(imp, tmp_path, monkeypatch, words, part) -> None:
    monkeypatch.chdir(tmp_path)
    late = read_tum(path(tmp_path, "good.tum")) + np.array([1e6, 0.0, 0.0, 0.0])
    write_tum(tmp_path / "late.tum", late)
    (tmp_path / "empty.tum").write_text("")
    (tmp_path / "bad.tum").write_text("<html>\n")
    (tmp_path / "good.relations").write_text("0 1 0 0 0 0 0 0\n")
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    (tmp_path / "good.csv").write_text("x,y\n1,2\n")
    folder(tmp_path)
    one_line(imp("evaluate", *words), part)


@pytest.mark.parametrize(("option", "name"), [("-o", "none/a.png"), ("--json", "none/a.json")])
def test_an_unwritable_file_is_a_one_line_error(imp, tmp_path, monkeypatch, option, name) -> None:
    monkeypatch.chdir(tmp_path)
    folder(tmp_path)
    said = imp("evaluate", "run", option, name, "--quiet")
    one_line(said, "cannot be written")


@pytest.mark.parametrize(
    "broken", ["trajectory.csv", "landmarks.csv", "truth.tum", "truth.landmarks.csv"]
)
def test_a_damaged_run_folder_is_one_line(imp, tmp_path, monkeypatch, broken) -> None:
    monkeypatch.chdir(tmp_path)
    (folder(tmp_path) / broken).write_bytes(b"\xff\xfe,\n1,2\n")
    one_line(imp("evaluate", "run"), broken)


def test_without_truth_a_map_is_compared_with_itself(imp, tmp_path) -> None:
    run = folder(tmp_path, truth=False)
    made(keyframes(RING, way(*LAP))).save(run / "map.imp")
    said = imp("evaluate", run, "--json", tmp_path / "numbers.json")
    assert said.code == 0, said.err
    assert "disagreement" in said.out
    numbers = json.loads((tmp_path / "numbers.json").read_text())["runs"][str(run)]
    assert 0.002 < numbers["quality"]["disagreement_m"] < 0.02
    assert numbers["path"] is None


def test_runs_without_truth_beside_others_are_named(imp, tmp_path) -> None:
    known, unknown = folder(tmp_path / "known"), folder(tmp_path / "unknown", truth=False)
    made(keyframes(RING, way(*LAP))).save(unknown / "map.imp")
    said = imp("evaluate", known, unknown)
    assert said.code == 0
    assert said.err == "imp: warning: no ground truth, so no errors of the path: unknown\n"
