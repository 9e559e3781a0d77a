"""Runs that end early: a signal, a full disk, an error. What is known by then is written."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.cli.forked import Forked

from impslam.cli.run_folder import RUN_FILES
from impslam.estimators.graph import Graph
from impslam.estimators.landmarks import Landmarks
from impslam.evaluation.tum import read_tum
from impslam.map import Map
from impslam.provenance import fingerprint

pytestmark = pytest.mark.usefixtures("undiagnosed")
WRITTEN = RUN_FILES - {"graph.g2o", "truth.landmarks.csv"}
SLOWLY = """
import resource, time
import impslam.cli.run
from impslam.cli import bar
from impslam.health import NO_FAULT
from impslam.observers import recorder, trajectory
diagnosis, impslam.cli.run._log_fault = impslam.cli.run._log_fault, lambda *_, **__: NO_FAULT
trajectory.FLUSH_ROWS = 1
{more}
bar.RunBar._advance = lambda self, scans: time.sleep(0.03 * scans)
"""
STUCK = "recorder.write_end = lambda *_: (print('writing', flush=True), time.sleep(60))"


def started(*words: object, more: str = "") -> Forked:
    """Start `imp` so that a scan takes 30 ms, without a diagnosis of the log."""
    return Forked(*words, setup=SLOWLY.format(more=more))


def wait_for_scans(process: Forked, folder: Path, scans: int = 20) -> None:
    """Wait until the run has written so many scans of its path."""
    end = time.monotonic() + 120.0
    path = folder / "trajectory.live.tum"
    while not (path.exists() and path.read_text().count("\n") >= scans):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)


def end(process: Forked, number: signal.Signals, within: float) -> str:
    """Send a signal, check that it ends the process within so many seconds; return stderr."""
    begin = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate()
    assert time.monotonic() - begin < within
    return err


def check_partial(folder: Path, log: Path, reason: str) -> Map:
    """Check that a folder holds all files of a part of the log, each of which says so."""
    assert {p.name for p in folder.iterdir()} >= WRITTEN
    known = Map.load(folder / "map.imp")
    n = len(known.stamps)
    assert 20 <= n < 100
    assert read_tum(folder / "trajectory.tum").shape == (n, 4)
    assert read_tum(folder / "trajectory.live.tum").shape == (n, 4)
    partial = json.loads((folder / "summary.json").read_text())["partial"]
    assert reason in partial
    assert f"the first {n} scans" in partial
    assert known.about["partial"] == partial
    assert known.about["counts"]["steps"] == n
    assert known.about["log_sha256"] == fingerprint(log)
    assert "Partial: " in (folder / "report.html").read_text()
    return known


@pytest.mark.parametrize(
    ("number", "reason", "code"),
    [
        (signal.SIGINT, "interrupted", 130),
        (signal.SIGTERM, "terminated", 143),
        (signal.SIGHUP, "terminal closed", 129),
    ],
)
def test_a_signal_leaves_a_complete_folder_of_a_partial_run(
    room, tmp_path, number, reason, code
) -> None:
    folder = tmp_path / "run"
    with started("run", room, "-o", folder) as process:
        wait_for_scans(process, folder)
        process.send_signal(number)
        _, err = process.communicate()
    assert process.returncode == code
    assert err == f"imp: {reason}; {folder} contains the map up to here, marked as partial\n"
    check_partial(folder, room, reason)


def test_a_signal_ends_the_refinement_and_keeps_the_map_before_it(room, tmp_path) -> None:
    slow = """
from impslam.estimators.landmarks import Landmarks
def refine(self):
    print("refining", flush=True)
    for _ in range(1200):
        time.sleep(0.05)
        self._checkpoint()
Landmarks.refine = refine
bar.RunBar._advance = lambda self, scans: None
"""
    folder = tmp_path / "run"
    with started("run", room, "-o", folder, "--quiet", more=slow) as process:
        assert "refining\n" in process.stdout
        err = end(process, signal.SIGTERM, 10.0)
    assert process.returncode == 143
    assert err == f"imp: terminated; {folder} contains the map up to here, marked as partial\n"
    known = Map.load(folder / "map.imp")
    assert len(known.stamps) == 100
    assert "the first 100 scans" in known.about["partial"]


def test_an_interrupted_run_is_a_prefix_and_can_be_continued(imp, room, tmp_path) -> None:
    folder, graph = tmp_path / "run", ("--set", "estimator.kind=graph")
    with started("run", room, "-o", folder, *graph) as process:
        wait_for_scans(process, folder)
        process.send_signal(signal.SIGINT)
        process.communicate()
    assert imp("run", room, "-o", tmp_path / "whole", *graph).code == 0
    part = read_tum(folder / "trajectory.live.tum")
    whole = read_tum(tmp_path / "whole" / "trajectory.live.tum")
    np.testing.assert_array_equal(part, whole[: len(part)])
    more = ("--map", folder / "map.imp")
    assert imp("run", room, "-o", tmp_path / "rest", *graph, *more).code == 0
    ends = [read_tum(tmp_path / name / "trajectory.tum") for name in ("whole", "rest")]
    np.testing.assert_array_equal(ends[0][:, 0], ends[1][:, 0])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.01)


def test_a_second_signal_stops_at_once(room, tmp_path) -> None:
    folder = tmp_path / "run"
    with started("run", room, "-o", folder, more=STUCK) as process:
        wait_for_scans(process, folder)
        process.send_signal(signal.SIGINT)
        assert "writing\n" in process.stdout
        err = end(process, signal.SIGINT, 5.0)
    assert process.returncode == 130
    assert err == f"imp: interrupted; {folder} contains trajectory.live.tum, truth.tum\n"
    assert len(read_tum(folder / "trajectory.live.tum")) >= 20
    facts = json.loads((folder / "summary.json").read_text())
    assert facts == {"partial": "the run has not ended"}


STAGES = ["impslam.open_log.open_log", "impslam.cli.run._log_fault", "bar.RunBar.__init__"]


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("signals", [1, 2])
def test_a_signal_before_the_first_scan_leaves_nothing(room, tmp_path, stage, signals) -> None:
    """The first lets the stage end, because native code may lose or not survive an exception."""
    seconds = 1.0 if signals == 1 else 60.0
    more = f"""
import impslam.open_log
impslam.cli.run._log_fault = diagnosis
stage = {stage}
def slow(*args, **options):
    print("begun", flush=True)
    time.sleep({seconds})
    print("ended", flush=True)
    return stage(*args, **options)
{stage} = slow
"""
    with started("run", room, "-o", tmp_path / "run", "--quiet", more=more) as process:
        assert "begun\n" in process.stdout
        for _ in range(signals):
            process.send_signal(signal.SIGINT)
            time.sleep(0.2)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "imp: interrupted\n")
    assert ("ended" in out) == (signals == 1)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("number", "said", "code"),
    [(signal.SIGINT, "interrupted", 130), (signal.SIGTERM, "terminated", 143)],
)
@pytest.mark.parametrize("words", [("merge", "a.imp", "b.imp"), ("localise", "a.imp", "log")])
def test_a_signal_ends_work_on_maps_with_one_line(tmp_path, words, number, said, code) -> None:
    slow = """
from impslam import localisation, map as maps
from impslam.maps import merge
maps.Map.load = staticmethod(lambda file: None)
def work(*_, **options):
    print("begun", flush=True)
    time.sleep(60.0)
localisation.localise = merge.merged = work
merge.check_logs = lambda *_: None
"""
    with started("map", *words, "-o", tmp_path / "out.imp", more=slow) as process:
        assert "begun\n" in process.stdout
        err = end(process, number, 5.0)
    assert (process.returncode, err) == (code, f"imp: {said}\n")
    assert not any(tmp_path.iterdir())


def test_a_signal_while_the_command_line_is_imported_is_one_line(tmp_path) -> None:
    (tmp_path / "cyclopts.py").write_text("raise KeyboardInterrupt")
    ended = subprocess.run(
        [sys.executable, "-c", "import impslam.cli"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (130, "imp: interrupted\n")


@pytest.mark.parametrize("whole", [False, True], ids=["on the way", "at the end"])
def test_a_full_disk_costs_only_the_files_that_do_not_fit(room, tmp_path, whole) -> None:
    """The size that a file may have stands for a disk: writing beyond it fails in the same way."""
    folder, size = tmp_path / "run", 30_000 if whole else 6_000
    limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))"
    limit += "; recorder.Recorder.truth = lambda *_: None"
    with started("run", room, "-o", folder, more=limit) as process:
        _, err = process.communicate()
    assert (process.returncode, err.count("\n")) == (2, 1)
    assert "File too large" in err
    assert f"{folder} contains config.toml, " in err
    partial = json.loads((folder / "summary.json").read_text())["partial"]
    assert "map.imp" in partial
    assert "could not be written (" in partial
    missing = WRITTEN - {"truth.tum"} - {p.name for p in folder.iterdir()}
    assert {"map.imp", "report.html"} < missing < WRITTEN
    assert all(name in partial for name in missing)
    path = read_tum(folder / "trajectory.live.tum")  # whole rows, as many as fit
    assert len(path) == 100 if whole else 40 < len(path) < 90


@pytest.mark.parametrize("estimator", [Landmarks, Graph])
@pytest.mark.parametrize("after", [False, True])
def test_an_error_keeps_what_was_mapped_before(
    imp, room, tmp_path, monkeypatch, estimator, after
) -> None:
    """Before the estimator has taken the keyframe in, or after: it then has one that the map has not."""
    add = estimator.add

    def failing(self, keyframe):
        revision = add(self, keyframe) if after or keyframe.id < 9 else None
        if keyframe.id == 9:
            raise ArithmeticError("a fault\nof two lines")
        return revision

    monkeypatch.setattr(estimator, "add", failing)
    folder = tmp_path / "run"
    kind = estimator.__name__.lower()
    more = ("--set", "keyframes.distance=0.03", "--set", f"estimator.kind={kind}")
    said = imp("run", room, "-o", folder, *more)
    assert (said.code, said.err.count("\n")) == (1, 1)
    assert "ArithmeticError: a fault of two lines" in said.err
    known = check_partial(folder, room, "ArithmeticError")
    assert len(known.keyframes) == 9
    assert np.isfinite(known.path()).all()
    assert "warning: " in imp("evaluate", folder).err
    assert "partial    ArithmeticError" in imp("map", "info", folder / "map.imp").out


def test_only_a_complete_run_replaces_another(imp, room, tmp_path) -> None:
    folder = tmp_path / "run"
    assert imp("run", room, "-o", folder).code == 0
    (folder / "notes.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    said = imp("run", room, "-o", folder)
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "contains a run; replace it with --force" in said.err

    beside = tmp_path / "run-partial"
    with started("run", room, "-o", folder, "--force", "--seed", "4") as process:
        wait_for_scans(process, beside)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate()
    assert process.returncode == 130
    assert err.endswith(f"; {folder} is unchanged\n")
    check_partial(beside, room, "interrupted")
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before

    said = imp("run", room, "-o", folder, "--force", "--seed", "4")
    assert said.code == 0, said.err
    assert f"report: {folder / 'report.html'}" in said.out
    assert json.loads((folder / "summary.json").read_text())["seed"] == 4
    assert (folder / "notes.txt").read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} == {"run", "run-partial"}


def test_a_partial_run_may_be_replaced(imp, room, tmp_path) -> None:
    (tmp_path / "trajectory.live.tum").write_text("")
    assert imp("run", room, "-o", tmp_path).code == 2
    assert imp("run", room, "-o", tmp_path, "--force").code == 0
    assert len(read_tum(tmp_path / "trajectory.tum")) == 100


def test_the_current_folder_is_not_replaced(imp, room, tmp_path, monkeypatch) -> None:
    assert imp("run", room, "-o", tmp_path).code == 0
    monkeypatch.chdir(tmp_path)
    said = imp("run", room, "-o", ".", "--force")
    assert said.code == 2
    assert "is the current folder" in said.err
