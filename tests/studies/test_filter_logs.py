"""Filters on recorded logs: their errors, wrong matches and memory, as one can count them by hand."""

import math

import numpy as np
import pytest

from impslam.evaluation.run_files import RecordedRun
from impslam.geometry.se2 import inverse, transform
from impslam.studies import filter_logs, filter_table
from impslam.studies.filter_logs import PARTS, RecordedData, errors, log_rows, measure
from impslam.studies.filter_scores import score_filters
from impslam.sweeps.job import Job

SPEED, TURN, STEP, SECONDS = 0.2, 0.1, 0.1, 60.0


@pytest.fixture(scope="module")
def circle(tmp_path_factory):
    """A robot that drives in a circle among six barcodes, in MRCLAM's files; four pictures are misread."""
    folder, rng = tmp_path_factory.mktemp("data") / "circle", np.random.default_rng(0)
    t = np.arange(0.0, SECONDS, STEP)
    theta, radius = TURN * t, SPEED / TURN
    true = np.column_stack((radius * np.sin(theta), radius * (1.0 - np.cos(theta)), theta))
    bearings = np.arange(6) * math.pi / 3.0
    marks = np.array([0.0, radius]) + 4.0 * np.column_stack((np.cos(bearings), np.sin(bearings)))
    seen = []
    for k in range(0, len(t), 5):
        x, y = transform(inverse(true[k]), marks).T
        for i in range(6):
            code = 70 + (i + 1) % 6 if 300 <= k < 320 else 70 + i
            depth, side = math.hypot(x[i], y[i]), math.atan2(y[i], x[i])
            noise = 0.01 * rng.normal(size=2)
            seen.append(f"{t[k]:.2f} {code} {depth + noise[0]} {side + noise[1]}")
    files = {
        "Barcodes": ["1 5", *(f"{6 + i} {70 + i}" for i in range(6))],
        "Robot1_Odometry": [f"{s:.2f} {SPEED} {TURN}" for s in t],
        "Robot1_Measurement": seen,
        "Robot1_Groundtruth": [
            f"{s:.2f} {a} {b} {c}" for s, (a, b, c) in zip(t, true, strict=True)
        ],
        "Landmark_Groundtruth": [f"{6 + i} {a} {b} 0 0" for i, (a, b) in enumerate(marks)],
    }
    folder.mkdir()
    for name, lines in files.items():
        (folder / f"{name}.dat").write_text("\n".join(lines) + "\n")
    return folder


EXACT = ("odometry.speed_scale=1", "odometry.turn_scale=1", "odometry.latency=0")
CAMERA = ("sensors.camera.depth=false", "sensors.camera.range_scale=1")


def test_a_drive_is_measured(circle):
    row = measure(filter_logs.FilterTask("circle", "ekf", circle, (*EXACT, *CAMERA), 1))
    assert row["position2"] < 0.03**2
    assert row["position2"] == pytest.approx(np.mean(row["position2_parts"]), rel=0.05)
    assert len(row["nees_parts"]) == PARTS
    assert 0.0 < row["nees"] < 12.0
    assert row["milliseconds"] > 0.0
    assert 6 * 50 < row["matched"] <= 6 * 120
    assert row["wrong"] == 0  # by `known`, which reads labels, also where those are misread


def test_observations_of_another_label_are_counted_where_labels_are_not_read(circle):
    unread = ("association.kind=mahalanobis", *EXACT, *CAMERA)
    row = measure(filter_logs.FilterTask("circle", "ekf", circle, unread, 1))
    assert row["wrong"] in (12, 18, 24)  # not each picture is a keyframe


def test_each_filter_maps_each_robot_in_a_process_of_its_own(circle, monkeypatch):
    logs = {
        "circle": RecordedData(circle.name, (*EXACT, *CAMERA), robots=(1, 2)),
        "elsewhere": RecordedData("no-such-folder"),
    }
    monkeypatch.setattr(filter_logs, "LOGS", logs)
    rows = log_rows({"ekf": ("filter.kind=ekf",)}, Job(data=circle.parent))
    assert [(row["world"], row["variant"], row["seed"]) for row in rows] == [
        ("circle", "ekf", 1),
        ("circle", "ekf", 2),
    ]
    assert 50.0 < rows[0]["megabytes"] < 500.0
    assert "robot" in rows[1]["error"]  # the log has one
    assert log_rows({"ekf": ()}, Job()) == []


def test_errors_are_those_of_the_path_where_it_fits_best():
    t = np.arange(100.0)
    truth = np.column_stack((t, t, np.zeros(100), np.zeros(100)))
    path = truth + np.array([0.0, 5.0, 2.0, 0.0])
    path[1::2, 2] += 0.2
    found = errors(RecordedRun(path, np.tile(np.eye(3), (100, 1, 1))), truth, truth)
    assert found["position2"] == pytest.approx(0.01, rel=1e-3)  # 0.1 m to either side
    assert found["nees"] == pytest.approx(
        0.02, rel=0.05
    )  # from the true start: 0.2 m, each other time


def test_without_a_true_heading_there_is_no_nees():
    t = np.arange(20.0)
    truth = np.column_stack((t, t, np.zeros(20), np.full(20, np.nan)))
    found = errors(RecordedRun(np.nan_to_num(truth), np.tile(np.eye(3), (20, 1, 1))), truth, truth)
    assert math.isnan(found["nees"])
    assert found["nees_parts"] == []


def test_a_log_whose_truth_has_no_headings_has_a_table_without_nees():
    """As the car park and Victoria Park, whose truth is GPS."""
    t = np.arange(100.0)
    truth = np.column_stack((t, t, np.sin(t), np.full(100, np.nan)))
    path = np.column_stack((truth[:, :3] + np.array([0.0, 5.0, 0.1]), np.zeros(100)))
    row = errors(RecordedRun(path, np.tile(np.eye(3), (100, 1, 1))), truth, path)
    given = {"world": "park", "variant": "ekf", "seed": 0, "error": "", "milliseconds": 1.0}
    scores = score_filters([{**given, **row, "position2_at_checks": math.nan}], "park")
    assert math.isnan(scores["ekf"].nees.value)
    header = filter_table._table("park", scores).header
    assert "position [m]" in header
    assert "pose NEES" not in header
