from pathlib import Path

import numpy as np
import pytest
from tests.sources.logs import read, write_lego

from impslam.columns import messages
from impslam.errors import SourceError
from impslam.sources.lego import Lego
from impslam.types import LaserScan, TruePose, WheelAngles


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_both_files_are_merged_by_time(tmp_path: Path, newline: str) -> None:
    found, source = read(write_lego(tmp_path / "robot", newline))
    wheels = [m for m in found if isinstance(m, WheelAngles)]
    scans = [m for m in found if isinstance(m, LaserScan)]
    assert [m.stamp for m in wheels] == [0.0, 0.25, 0.5, 0.75]
    np.testing.assert_allclose([m.stamp for m in scans], [0.575, 0.825, 1.075])
    assert [m.stamp for m in found] == sorted(m.stamp for m in found)
    true = [m.pose for m in found if isinstance(m, TruePose)]
    np.testing.assert_array_equal(true, [[1e-3, 2e-3, np.nan]])
    assert [(m.left, m.right) for m in wheels] == [(100 + i, 200 + i) for i in range(4)]
    np.testing.assert_array_equal(scans[0].ranges, np.full(660, 1.5))
    assert np.degrees(scans[0].angles[[0, -1]]) == pytest.approx([-120.0, 111.7], abs=0.1)
    assert source.preset == "lego-robot4"
    assert not source.problems.counts


def test_position_runs_to_the_total(tmp_path: Path) -> None:
    with Lego(path=write_lego(tmp_path / "robot")) as source:
        steps = [source.position for _ in messages(source.batches(1))]
        assert source.position == source.total
    assert steps == sorted(steps)


def test_streams_show_the_reference_as_unused(tmp_path: Path) -> None:
    with Lego(path=write_lego(tmp_path / "robot")) as source:
        shown = {s.name: (s.count, s.used) for s in source.streams()}
    assert shown == {
        "run_motors.txt": (4, True),
        "run_scan.txt": (3, True),
        "run_reference.txt": (1, False),
    }


@pytest.mark.parametrize(
    ("file", "bad"),
    [
        ("run_motors.txt", "M 1 2 3"),
        ("run_motors.txt", "M 1 nan 3 4 5 6 7"),
        ("run_motors.txt", "X 1 2 3 4 5 6 7"),
        ("run_scan.txt", "S 10 660 1 2 3"),
        ("run_scan.txt", "S inf 1 5"),
        ("run_scan.txt", "S 1 -1"),
        ("run_scan.txt", "S 1 2 5 x"),
    ],
)
def test_bad_lines_are_counted_and_dropped(tmp_path: Path, file: str, bad: str) -> None:
    folder = write_lego(tmp_path / "robot")
    with (folder / file).open("a") as end:
        end.write(bad + "\n")
    found, source = read(folder)
    assert len(found) == 8
    assert len(source.problems.counts) == 1
    (example,) = source.problems.examples.values()
    assert file in example


def test_a_folder_without_a_pair_is_refused(tmp_path: Path) -> None:
    folder = write_lego(tmp_path / "robot")
    (folder / "run_scan.txt").unlink()
    assert not Lego.recognises(folder)
    with pytest.raises(SourceError, match=r"_scan\.txt"):
        Lego(path=folder).__enter__()


def test_cylinders_beside_the_log_are_true_landmarks(tmp_path: Path) -> None:
    folder = write_lego(tmp_path / "robot")
    (folder / "arena_landmarks.txt").write_text("L C 1291.0\t1881.0\t55.0\nL C 482 682 55\n# x\n")
    with Lego(path=folder) as source:
        marks = source.true_landmarks()
        assert [s.count for s in source.streams() if s.type == "cylinders"] == [2]
    assert [m.kind for m in marks] == ["cylinder", "cylinder"]
    np.testing.assert_allclose([m.position for m in marks], [[1.291, 1.881], [0.482, 0.682]])


def test_bad_lines_of_cylinders_are_counted_and_dropped(tmp_path: Path) -> None:
    folder = write_lego(tmp_path / "robot")
    lines = ["L C abc def 10", "L C 482", "L C nan 682 55", "L C 482 682 55"]
    (folder / "arena_landmarks.txt").write_text("\n".join(lines))
    with Lego(path=folder) as source:
        (mark,) = source.true_landmarks()
        assert source.problems.counts == {"malformed L line": 3}
        assert "arena_landmarks.txt:1: " in source.problems.examples["malformed L line"]
    np.testing.assert_allclose(mark.position, [0.482, 0.682])


@pytest.mark.real
def test_real_run(data_folder: Path) -> None:
    found, source = read(data_folder / "lego-robot4")
    assert sum(isinstance(m, LaserScan) for m in found) == 278
    assert sum(isinstance(m, WheelAngles) for m in found) == 278
    assert set(source.problems.counts) == {"repeated stamp"}
    assert all(len(m.ranges) == 660 for m in found if isinstance(m, LaserScan))
