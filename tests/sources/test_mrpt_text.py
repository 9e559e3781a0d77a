"""MRPT's text exports: increments add up to poses, detections, and the truth beside them."""

import math

import numpy as np
import pytest
from tests.sources.logs import read, write_mrpt_text

from impslam.columns import messages
from impslam.sources.mrpt_text import MrptText
from impslam.types import Detections, OdometryPose, TruePose


def of(found, kind):
    return [m for m in found if isinstance(m, kind)]


def test_increments_add_up_and_steps_are_stamps(tmp_path):
    found, source = read(write_mrpt_text(tmp_path / "log.txt"))
    poses, seen = of(found, OdometryPose), of(found, Detections)
    assert [m.stamp for m in poses] == [m.stamp for m in seen] == [0.0, 1.0, 2.0]
    c, s = math.cos(0.25), math.sin(0.25)
    expected = [[0, 0, 0], [0.5, 0, 0.25], [0.5 + 0.5 * c - 0.125 * s, 0.5 * s + 0.125 * c, 0]]
    np.testing.assert_allclose([m.pose for m in poses], expected, atol=1e-15)
    assert source.preset == "kf-demo"
    assert not source.problems.counts


def test_detections(tmp_path):
    found, _ = read(write_mrpt_text(tmp_path / "log.txt"))
    first, _, empty = of(found, Detections)
    np.testing.assert_array_equal(first.ranges, [2.5, 1.5])
    np.testing.assert_array_equal(first.bearings, [0.25, -0.5])
    np.testing.assert_array_equal(first.labels, [7, -1])
    assert len(empty.ranges) == 0


def test_a_detection_above_the_plane_is_projected(tmp_path):
    log = write_mrpt_text(tmp_path / "log.txt")
    with log.open("a") as file:
        file.write("BR 0 0 0 0 1 3 2.0 0.5 1.0471975511965976\n")
    found, _ = read(log)
    np.testing.assert_allclose(of(found, Detections)[-1].ranges, [1.0])


@pytest.mark.parametrize(
    "bad",
    [
        "BR 0 0 0 0 2 7 2.0 0.5 0.0",
        "BR 0 0 0 0 -1",
        "BR 0 0 0 0 1 nan 2.0 0.5 0.0",
        "BR 0 0 0 0 x",
        "ODOINC 0.0 0.5",
        "ODOINC 0.0 inf 0 0",
        "ODOINC 0.0 1e300 0 0",
        "3 4 5",
    ],
)
def test_a_bad_line_is_counted_and_the_rest_is_read(tmp_path, bad):
    log = write_mrpt_text(tmp_path / "log.txt")
    before = len(read(log)[0])
    with log.open("a") as file:
        file.write(bad + "\n")
    found, source = read(log)
    assert len(found) == before
    assert sum(source.problems.counts.values()) == 1
    assert f"{log}:7" in next(iter(source.problems.examples.values()))


def test_the_truth_beside_the_log(tmp_path):
    log = write_mrpt_text(tmp_path / "log.txt")
    (tmp_path / "log_ground_truth.txt").write_text("1.5 -2.0 0 5 0 0 7\n")
    rows = ["% x y z yaw pitch roll", *(f"{k} 1 0 0.25 0 0" for k in range(3))]
    (tmp_path / "log_ground_truth_robot_path.txt").write_text("\n".join(rows) + "\n")
    found, source = read(log)
    true = of(found, TruePose)
    assert [m.stamp for m in true] == [0.0, 1.0, 2.0]
    np.testing.assert_array_equal([m.pose for m in true], [[k, 1, 0.25] for k in range(3)])
    (mark,) = source.true_landmarks()
    assert (mark.name, mark.kind, *mark.position) == ("7", "point", 1.5, -2.0)


def test_position_runs_to_the_total(tmp_path):
    (tmp_path / "log_ground_truth_robot_path.txt").write_text("0 0 0 0 0 0\n" * 9)
    with MrptText(path=write_mrpt_text(tmp_path / "log.txt")) as source:
        steps = [source.position for _ in messages(source.batches(1))]
        assert steps == sorted(steps)
        assert source.position == source.total


@pytest.mark.real
def test_real_log(data_folder):
    found, source = read(data_folder / "kf-demo" / "kf-slam_demo.txt")
    seen = of(found, Detections)
    assert sum(len(m.ranges) for m in seen) == 3607
    assert len(seen) == len(of(found, TruePose)) == 250
    assert len(source.true_landmarks()) == 70
    assert not source.problems.counts
