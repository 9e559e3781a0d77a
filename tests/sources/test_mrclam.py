"""MRCLAM's folders: one robot's messages by time, its pictures, and what is left out."""

from pathlib import Path

import numpy as np
import pytest
from tests.sources.logs import MRCLAM, read, write_mrclam

from impslam.columns import messages
from impslam.errors import SourceError
from impslam.sources import mrclam
from impslam.sources.mrclam import Mrclam
from impslam.types import Detections, TruePose, Velocity


def write_robot(folder: Path, number: int) -> None:
    for what in ("Odometry", "Measurement"):
        text = "\n".join(MRCLAM[f"Robot2_{what}"]) + "\n"
        (folder / f"Robot{number}_{what}.dat").write_text(text)


def of(found, kind):
    return [m for m in found if isinstance(m, kind)]


def test_all_files_are_merged_by_time(tmp_path):
    found, source = read(write_mrclam(tmp_path / "set"))
    assert [m.stamp for m in found] == sorted(m.stamp for m in found)
    assert len(of(found, Velocity)) == 9
    assert len(of(found, TruePose)) == 24
    first = of(found, Velocity)[0]
    assert (first.stamp, first.speed, first.turn_rate) == (100.0, 0.125, -0.5)
    np.testing.assert_array_equal(of(found, TruePose)[1].pose, [1.5, 1.0, -3.0])
    assert source.preset == "mrclam"
    assert not source.problems.counts


def test_a_picture_has_the_landmarks_seen_within_milliseconds_but_no_robots(tmp_path):
    found, _ = read(write_mrclam(tmp_path / "set"))
    pictures = of(found, Detections)
    assert [m.stamp for m in pictures] == [100.5, 101.0, 101.25, 101.5, 101.75]
    np.testing.assert_array_equal(pictures[0].labels, [6, 7])  # subjects of barcodes 63 and 81
    np.testing.assert_array_equal(pictures[0].ranges, [2.5, 3.0])
    np.testing.assert_array_equal(pictures[0].bearings, [0.25, -0.25])
    assert np.isnan(pictures[0].diameters).all()


def test_an_unknown_barcode_is_a_problem_that_names_its_line(tmp_path):
    folder = write_mrclam(tmp_path / "set")
    with (folder / "Robot2_Measurement.dat").open("a") as file:
        file.write("103.0 43 2.0 0.0\n103.5 63 nan 0.0\n")
    found, source = read(folder)
    assert source.problems.counts == {"unknown barcode": 1, "malformed Robot2_Measurement line": 1}
    assert "Robot2_Measurement.dat:10: barcode 43" in source.problems.examples["unknown barcode"]
    assert len(of(found, Detections)) == 5


def test_the_robot_is_chosen_by_parameter_or_file(tmp_path):
    folder = write_mrclam(tmp_path / "set")
    write_robot(folder, 4)
    assert Mrclam(path=folder)._number == 2
    assert Mrclam(path=folder, robot=4)._number == 4
    assert Mrclam(path=folder / "Robot4_Odometry.dat")._number == 4
    assert Mrclam.recognises(folder / "Robot4_Measurement.dat")
    with Mrclam(path=folder, robot=4) as source:
        assert not of(list(messages(source.batches())), TruePose)  # without a tracked path
        others = [s for s in source.streams() if s.note == "--set source.robot=2"]
        assert [s.name for s in others] == ["Robot2_*.dat"]


def test_the_robot_is_searched_once_however_often_the_size_is_asked(tmp_path, monkeypatch):
    searched, robots = [], mrclam._robots
    monkeypatch.setattr(mrclam, "_robots", lambda folder: searched.append(folder) or robots(folder))
    folder = write_mrclam(tmp_path / "set")
    with Mrclam(path=folder) as source:
        assert len({source.total for _ in source.batches(1)}) == 1
    assert searched == [folder]


def test_a_missing_robot_is_an_error_that_lists_the_others(tmp_path):
    folder = write_mrclam(tmp_path / "set")
    with pytest.raises(SourceError, match=r"robot 3; available: 2; choose one with --set"):
        Mrclam(path=folder, robot=3).__enter__()


def test_true_landmarks_and_position(tmp_path):
    with Mrclam(path=write_mrclam(tmp_path / "set")) as source:
        assert [(t.name, t.kind, *t.position) for t in source.true_landmarks()] == [
            ("6", "point", 1.0, 2.0),
            ("7", "point", -1.5, 0.5),
        ]
        steps = [source.position for _ in messages(source.batches(1))]
        assert steps == sorted(steps)
        assert source.position == source.total


@pytest.mark.real
def test_real_robots(data_folder):
    for robot, pictures in ((1, 962), (4, 1111)):
        found, source = read(data_folder / "mrclam6", robot=robot)
        seen = of(found, Detections)
        assert len(seen) == pictures
        assert set(np.concatenate([m.labels for m in seen])) == set(range(6, 21))
        assert len(source.true_landmarks()) == 15
        assert source.problems.counts["unknown barcode"] in {1, 3}
