"""The controlled experiments: the print, the metrics, the tables, and one seed as a whole."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from impslam.evaluation.json_values import json_values
from impslam.map import PathRows
from impslam.simulation.world import load_world
from impslam.studies import arena
from impslam.studies.arena_experiment import (
    CORNERS,
    END,
    NAMED,
    Experiment,
    landmark_metrics,
    summary,
    true_landmarks,
)
from impslam.studies.arena_seeds import MIN_DRIFT, dead_reckoning_error, drifting_seeds
from impslam.studies.arena_tables import (
    END_POSITION,
    TRUE,
    distance_table,
    off_middle,
    too_far,
    turned,
    wall_table,
)
from impslam.studies.map_plot import ARENA, draw_maps
from impslam.studies.sweep import StudyRun, Variant, path_metrics, sweep
from impslam.sweeps.job import Job
from impslam.types import Landmark

POINTS, LINES, BOTH = (Experiment.load(name) for name in ("points", "lines", "both"))
DETECTED = {experiment.name: experiment.printed for experiment in (POINTS, LINES, BOTH)}
SQUARED = {  # the tables' own column, "Error (m)"
    "points": {"cylinder 1": 0.002622, "cylinder 2": 0.022048, "cylinder 3": 0.097665},
    "lines": {"wall 1": 0.017547, "wall 2": 0.000012, "wall 3": 0.108611, "wall 4": 0.005526},
    "both": {"cylinder 1": 0.004602, "wall 1": 0.002145, "wall 3": 0.134878, "wall 4": 0.004747},
}
ENDS = {"points": 0.023072, "lines": 0.008721, "both": 0.00457}


# ------------------------------------------------------------------------------- the print


@pytest.mark.parametrize("name", SQUARED)
def test_the_printed_errors_are_squares_of_the_printed_positions(name):
    for mark, squared in SQUARED[name].items():
        distance = math.dist(DETECTED[name][mark], TRUE[mark].position)
        assert distance**2 == pytest.approx(squared, abs=1.5e-5)
    assert math.dist(DETECTED[name][END], END_POSITION) ** 2 == pytest.approx(ENDS[name], abs=1e-5)


def test_errors_of_the_printed_positions():
    first, second = (DETECTED["points"][f"cylinder {i}"] for i in (1, 2))
    assert math.dist(first, second) == pytest.approx(1.97, abs=0.005)
    true = [TRUE[f"cylinder {i}"].position for i in (1, 2, 3)]
    assert math.dist(true[0], true[1]) == pytest.approx(1.93, abs=0.005)
    assert math.dist(true[1], true[2]) == pytest.approx(1.93, abs=0.005)
    turns = [
        math.degrees(turned(DETECTED["points"][name], TRUE[name].position)) for name in POINTS.names
    ]
    assert turns == pytest.approx([1.5, 2.2, 3.15], abs=0.05)
    assert math.hypot(*true[2]) * math.radians(1.5) == pytest.approx(0.14, abs=0.005)
    shares = [
        too_far(DETECTED["both"][name], TRUE[name].position) / math.hypot(*TRUE[name].position)
        for name in POINTS.names
    ]
    assert min(shares) > 0.009
    assert max(shares) < 0.03
    assert off_middle(DETECTED["both"]["wall 3"], TRUE["wall 3"]) < 0.01
    assert off_middle(DETECTED["both"]["wall 1"], TRUE["wall 1"]) < 0.01
    assert off_middle(DETECTED["lines"]["wall 3"], TRUE["wall 3"]) == pytest.approx(0.263, abs=1e-3)


@pytest.mark.parametrize(("name", "wider"), [("lines", 0.028), ("both", 0.022)])
def test_the_printed_arena_is_too_wide(name, wider):
    width = math.hypot(*DETECTED[name]["wall 2"]) + math.hypot(*DETECTED[name]["wall 4"])
    assert width / (0.3048 + 1.6764) - 1.0 == pytest.approx(wider, abs=1e-3)


def test_the_turn_is_counter_clockwise_and_wrapped():
    assert turned((math.cos(3.2), math.sin(3.2)), np.array([-1.0, 1e-9])) > 0.0
    assert turned((0.0, 1.0), np.array([1.0, 0.0])) == pytest.approx(math.pi / 2)


# ------------------------------------------------------------------------------- the scores


def mark(true, by=0.0, number=0, kind=None):
    """An estimate of a true landmark that is off by so much, across if a wall."""
    values = dict(true.parameters)
    if true.end_points is not None:
        values["r"] += by
        away = np.array([math.cos(values["alpha"]), math.sin(values["alpha"])]) * by
        return Landmark(
            number,
            "wall",
            true.position + away,
            values,
            1e-4 * np.eye(2),
            true.end_points + away,
            9,
            0,
            1,
        )
    place = true.position + np.array([by, 0.0])
    return Landmark(number, kind or true.kind, place, values, 1e-4 * np.eye(2), None, 9, 0.0, 1.0)


def run(seed=0, by=0.0, without=(), more=(), end=0.0):
    """Return a run at rest, `end` off along x, whose map is off by so much."""
    path = np.zeros((5, 3)) + np.array([end, 0.0, 0.0])
    marks = [mark(m, by, i) for i, m in enumerate(true_landmarks()) if m.name not in without]
    return StudyRun(
        load_world("arena"),
        Variant("default"),
        seed,
        [],
        np.zeros((5, 3)),
        PathRows(np.zeros(5), path, np.tile(np.eye(3), (5, 1, 1)), path + 0.5),
        [],
        (*marks, *more),
        [],
    )


def row(*args, **kwargs):
    made = run(*args, **kwargs)
    return {"seed": made.seed, **path_metrics(made), **landmark_metrics(made)}


def test_a_perfect_map_has_no_errors():
    result = summary([row()], NAMED)
    assert all(not result[key] for key in result if key.startswith("seeds_"))
    assert set(result["distance"]) == {*NAMED, END}
    assert all(q.high == pytest.approx(0.0, abs=1e-9) for q in result["distance"].values())
    assert result["pose_nees"] == 0.0
    assert result["pose_nees_within_95"] == 1.0


def test_errors_are_those_put_in():
    result = summary([row(0, 0.01, end=0.02)], NAMED)["distance"]
    assert all(result[name].median == pytest.approx(0.01) for name in NAMED)
    assert result[END].median == pytest.approx(0.02)


def test_missing_false_and_double_are_distinguished():
    ghost = Landmark(90, "cylinder", np.array([0.0, 0.9]), {}, np.eye(2), None, 9, 0.0, 1.0)
    twice = mark(TRUE["cylinder 1"], 0.05, 91)
    rows = [
        row(0),
        row(1, without=["cylinder 2"]),
        row(2, more=[ghost]),
        row(3, more=[twice]),
        row(4, without=CORNERS[:1]),
    ]
    result = summary(rows, NAMED)
    lists = [result[f"seeds_{what}"] for what in ("missing", "false", "double", "corner_missing")]
    assert lists == [[1], [2], [3], [4]]


def test_a_landmark_missing_in_most_seeds_is_not_left_out_of_the_median():
    rows = [row(0), row(1, without=["wall 3"]), row(2, without=["wall 3"])]
    result = summary(rows, NAMED)
    assert result["distance"]["wall 3"].median == math.inf
    json.dumps(json_values(result), allow_nan=False)
    shown = {cells[0]: cells[-1] for cells in wall_table(LINES, {"default": rows}).rows}
    assert "missing" in shown["wall 3"]


def test_landmarks_that_the_experiment_is_not_about_may_be_missing():
    assert summary([row(0, without=NAMED[:4])], POINTS.names)["seeds_missing"] == []


def test_an_overconfident_estimate_is_detected():
    result = summary([row(0, end=3.0)], NAMED)
    assert result["pose_nees_within_95"] == 0.0
    assert result["pose_nees"] == pytest.approx(9.0)


def test_tables_have_a_row_for_each_landmark_and_the_print_in_metres():
    runs = {"default": [row(0, 0.01)]}
    table = distance_table(BOTH, runs)
    assert [cells[0] for cells in table.rows] == [*BOTH.names, END]
    assert all(len(cells) == len(table.header) for cells in table.rows)
    wall = wall_table(LINES, runs)
    assert [cells[:2] for cells in wall.rows] == [
        ["wall 1", "0.122"],
        ["wall 2", "0.014"],
        ["wall 3", "0.263"],
        ["wall 4", "0.135"],
    ]
    assert {cells[2] for cells in wall.rows} == {"0.010 [0.010, 0.010]"}


def test_the_picture_is_the_same_bytes_each_time():
    pictured = {"one": run(), "lost": run(1, 0.4, without=["wall 1"], end=3.0)}
    png = draw_maps(pictured, ARENA)
    assert png.startswith(b"\x89PNG")
    assert png == draw_maps(pictured, ARENA)


# ------------------------------------------------------------------------------- the runs


def test_seeds_are_selected_by_dead_reckoning():
    chosen = drifting_seeds(Job(), 2)
    drifts = {seed: dead_reckoning_error(seed) for seed in range(chosen[-1] + 1)}
    assert chosen == [seed for seed, drift in drifts.items() if drift >= MIN_DRIFT]


def test_the_default_maps_the_arena_and_its_odometry_is_dead_reckoning():
    (first,) = sweep([Variant("default")], [0], measure=landmark_metrics)
    assert first["odometry_end"] == pytest.approx(dead_reckoning_error(0), abs=1e-9)
    assert first["end"] < 0.01
    assert not set(first["missing"]) & set(NAMED)
    assert first["false"] == ()


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [POINTS, LINES, BOTH], ids=lambda e: e.name)
def test_every_interpretation_of_the_text_is_a_valid_config(experiment):
    for variant in experiment.interpretations:
        config = variant.config(load_world("arena"), 0)
        config.make_estimator()
        config.make_robot()


def test_the_printed_gate_loses_the_map_and_the_one_of_squares_keeps_it(monkeypatch):
    """With one interpretation of the text: the others are variants like it."""
    shorter = replace(POINTS, interpretations=POINTS.interpretations[:1])
    monkeypatch.setattr(Experiment, "load", lambda name: shorter)
    steps = []
    part = arena.points(Job(1, progress=lambda *step: steps.append(step)))
    assert part.name == "points"
    json.dumps(json_values(part.numbers), allow_nan=False)
    assert part.numbers["2_m_gate"]["seeds_missing"] == part.numbers["seeds"]
    assert part.numbers["thesis"]["distance"][END].median < 0.05
    assert part.numbers["default"]["distance"][END].median < 0.01
    assert len(part.runs) == len(shorter.variants) + len(shorter.interpretations)
    assert list(part.numbers["readings"]) == [shorter.interpretations[0].name]
    assert steps
