"""The run folder contains the documented files, with the same bytes every time."""

import errno
import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.g2o import read_g2o
from tests.observers import runs

from impslam.errors import ImpError
from impslam.evaluation.landmark_files import read_true_landmarks
from impslam.evaluation.tum import read_tum
from impslam.imported_map import FREE, OCCUPIED, read_grid
from impslam.map import Map
from impslam.maps.landmark_table import read_landmarks
from impslam.observers import map_files
from impslam.observers.recorder import Recorder
from impslam.observers.run_folder import write_run
from impslam.types import Edges, TrueLandmark

FILES = {
    *("trajectory.tum", "odometry.tum", "trajectory.csv", "landmarks.csv"),
    *("map.pgm", "map.yaml", "summary.json", "config.toml", "trajectory.live.tum", "map.imp"),
    *("report.html", "report.png"),
}


@pytest.fixture
def folder(tmp_path):
    runs.play([Recorder(tmp_path / "a" / "run")])
    return tmp_path / "a" / "run"


def test_it_writes_the_documented_files_and_no_others(folder):
    assert {p.name for p in folder.iterdir()} == FILES


def test_the_path_has_the_stamps_of_the_log_in_order(folder):
    rows = read_tum(folder / "trajectory.tum")
    results = list(runs.make_results())
    np.testing.assert_array_equal(rows[:, 0], [r.stamp for r in results])
    np.testing.assert_allclose(rows[:, 1:3], [r.pose[:2] for r in results], atol=1e-9)
    turn = rows[:, 3] - [r.pose[2] for r in results]
    np.testing.assert_allclose(np.sin(turn), 0.0, atol=1e-9)
    dead = read_tum(folder / "odometry.tum")
    np.testing.assert_allclose(dead[:, 1:3], [r.odometry[:2] for r in results], atol=1e-9)


def test_the_table_contains_the_covariance(folder):
    table = np.genfromtxt(folder / "trajectory.csv", delimiter=",", names=True)
    names = ("stamp", "x", "y", "theta", "xx", "xy", "xt", "yy", "yt", "tt", "health")
    assert table.dtype.names == names
    for row, result in zip(table, runs.make_results(), strict=True):
        np.testing.assert_allclose(row["yy"], result.covariance[1, 1], rtol=1e-9)
        np.testing.assert_allclose(row["tt"], result.covariance[2, 2], rtol=1e-9)


def test_the_map_shows_the_room(folder):
    grid = read_grid(folder / "map.yaml")
    rows, columns = grid.cells.shape
    assert grid.origin[:2] == pytest.approx([-3, -2], abs=0.11)
    assert grid.resolution * np.array([columns, rows]) == pytest.approx([6, 6], abs=0.22)
    assert (grid.cells == FREE).mean() > 0.5
    assert (grid.cells == OCCUPIED).any()


def test_landmarks_summary_and_config(folder):
    assert [mark.id for mark in read_landmarks(folder / "landmarks.csv")] == [7, 8]
    facts = json.loads((folder / "summary.json").read_text())
    assert facts["counts"]["steps"] == 50
    assert facts["landmarks"] == {"cylinder": 1, "wall": 1}
    assert facts["dropped"]["nan ranges"]["count"] == 2
    assert facts["seed"] == 3
    assert facts["time"]["real_time_factor"] == 250.0
    assert set(facts["time"]["stages_ms"]["slam"]) == {"mean", "p50", "p99"}
    assert facts["path_length_m"]["slam"] == pytest.approx(2 * np.pi, rel=0.02)
    assert facts["versions"]["numpy"] == np.__version__
    config = tomllib.loads((folder / "config.toml").read_text())
    assert config["odometry"] == {"kind": "encoders", "track": 0.3}


def test_equal_runs_give_equal_bytes_except_for_times(tmp_path):
    for name, seconds in (("a", 1.0), ("b", 2.0)):
        outcome = runs.make_outcome(wall_seconds=seconds)
        runs.play([Recorder(tmp_path / name)], outcome=outcome)
    for name in FILES - {"summary.json", "report.html"}:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    a, b = (json.loads((tmp_path / n / "summary.json").read_text()) for n in "ab")
    assert a.pop("time") != b.pop("time")
    assert a == b


def test_a_run_that_is_cut_short_leaves_its_path(tmp_path):
    run = runs.Scripted(Recorder(tmp_path))
    for result in runs.make_results(250):
        run.step(result)
    assert len(read_tum(tmp_path / "trajectory.live.tum")) == 200


def test_a_saved_map_loads_completely(tmp_path):
    saved = runs.play([Recorder(tmp_path)])
    known = Map.load(tmp_path / "map.imp")
    np.testing.assert_array_equal(known.path(), saved.path())
    live = read_tum(tmp_path / "trajectory.live.tum")
    np.testing.assert_allclose(known.live_path(), live, atol=1e-8)
    assert [mark.id for mark in known.landmarks] == [7, 8]


def test_the_pose_graph_is_written_if_there_is_one(tmp_path):
    edges = Edges(
        np.array([2, 9, 2]),
        np.array([9, 20, 20]),
        np.arange(9.0).reshape(3, 3) / 10.0,
        np.array([np.diag([1.0, 2.0, 3.0])] * 3),
        np.array([np.inf, np.inf, 25.0]),
    )
    known = replace(runs.play([Recorder(tmp_path)]), edges=edges)
    assert not (tmp_path / "graph.g2o").exists()
    Recorder(tmp_path).finish(known, runs.make_outcome())
    graph = read_g2o(tmp_path / "graph.g2o")
    assert graph.ids.tolist() == [2, 9, 20]
    np.testing.assert_array_equal(graph.poses, known.keyframes.poses[graph.ids])
    np.testing.assert_array_equal(graph.ids[graph.edges.i], edges.i)
    np.testing.assert_array_equal(graph.ids[graph.edges.j], edges.j)
    np.testing.assert_array_equal(graph.edges.T_i_j, edges.T_i_j)
    np.testing.assert_allclose(graph.edges.information, edges.information, atol=1e-12)
    assert graph.fixed.tolist() == [0]


def test_an_old_run_is_overwritten(folder):
    runs.play([Recorder(folder)], n=5)
    assert len(read_tum(folder / "trajectory.tum")) == 5


def test_truth_is_written_if_there_is_one(tmp_path):
    runs.play([Recorder(tmp_path)], truth=runs.make_truth())
    assert len(read_tum(tmp_path / "truth.tum")) == 50


def test_a_run_without_scans_landmarks_or_time(tmp_path):
    nothing = {"stages": {"estimate": np.empty(0)}, "wall_seconds": 0.0}
    Recorder(tmp_path).finish(runs.Scripted().map(), runs.make_outcome(**nothing))
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert facts["time"]["real_time_factor"] is None
    assert facts["time"]["stages_ms"]["estimate"]["mean"] is None


def test_a_folder_that_cannot_be_created_is_a_one_line_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ImpError, match="choose another -o"):
        Recorder(tmp_path / "file" / "run")


def test_a_truth_without_headings_is_written_with_nan(tmp_path):
    truth = [runs.TruePose(p.stamp, np.array([*p.pose[:2], np.nan])) for p in runs.make_truth()]
    runs.play([Recorder(tmp_path)], truth=truth)
    rows = read_tum(tmp_path / "truth.tum")
    assert np.isnan(rows[:, 3]).all()
    np.testing.assert_allclose(rows[:, 1:3], [p.pose[:2] for p in truth], atol=1e-9)


def test_true_landmarks_are_written_if_there_are_any(tmp_path):
    known = [TrueLandmark("a", "cylinder", np.array([1.0, 2.0]), {"radius": 0.1})]
    runs.play([Recorder(tmp_path, known)])
    (back,) = read_true_landmarks(tmp_path / "truth.landmarks.csv")
    assert (back.name, back.kind, back.parameters["radius"]) == ("a", "cylinder", 0.1)
    np.testing.assert_array_equal(back.position, known[0].position)


def test_a_run_whose_sensor_has_no_scans_writes_no_empty_grid(tmp_path):
    run = runs.Scripted()
    for result in runs.make_results(5):
        run.step(replace(result, scan=None))
    write_run(tmp_path, run.map(), runs.make_outcome(5))
    assert not {"map.pgm", "map.yaml"} & {path.name for path in tmp_path.iterdir()}
    assert '"columns": 1' in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("failing", ["write_landmarks", "write_map"])
def test_on_a_full_disk_the_files_of_the_earlier_run_stay(tmp_path, monkeypatch, failing):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    write_run(tmp_path, runs.play([], n=5), runs.make_outcome(5))
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(map_files, failing, fail)
    said = rf"^{tmp_path}: .* could not be written \(No space left on device\); free disk space"
    with pytest.raises(ImpError, match=said):
        write_run(tmp_path, runs.play([]), runs.make_outcome())
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files
    monkeypatch.undo()
    write_run(tmp_path, runs.play([]), runs.make_outcome())
    assert {path.name for path in tmp_path.iterdir()} == FILES == files.keys()
    assert len(read_tum(tmp_path / "trajectory.tum")) == 50
