"""The controlled experiments: what is scored, what is printed, and that one seed goes through."""

import json
import math

import numpy as np
import pytest

from impslam.studies import arena
from impslam.studies.arena_plot import arena_png
from impslam.studies.arena_print import DETECTED, END, off_middle, too_far, turned
from impslam.studies.arena_runs import (
    DEFAULT,
    OFF,
    ArenaRun,
    dead_reckoning,
    drifting,
    runs,
    true_landmarks,
)
from impslam.studies.arena_scores import CORNERS, NAMED, Spread, errors, representative
from impslam.studies.arena_setups import BOTH, LINES, POINTS
from impslam.studies.arena_tables import END_POSITION, TRUTH, distance_table, wall_table
from impslam.studies.base import Job
from impslam.types import Landmark

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
        distance = math.dist(DETECTED[name][mark], TRUTH[mark].position)
        assert distance**2 == pytest.approx(squared, abs=1.5e-5)
    assert math.dist(DETECTED[name][END], END_POSITION) ** 2 == pytest.approx(ENDS[name], abs=1e-5)


def test_what_is_said_of_the_print():
    first, second = (DETECTED["points"][f"cylinder {i}"] for i in (1, 2))
    assert math.dist(first, second) == pytest.approx(1.97, abs=0.005)
    true = [TRUTH[f"cylinder {i}"].position for i in (1, 2, 3)]
    assert math.dist(true[0], true[1]) == pytest.approx(1.93, abs=0.005)
    assert math.dist(true[1], true[2]) == pytest.approx(1.93, abs=0.005)
    turns = [
        math.degrees(turned(DETECTED["points"][name], TRUTH[name].position))
        for name in POINTS.names
    ]
    assert turns == pytest.approx([1.5, 2.2, 3.15], abs=0.05)
    assert math.hypot(*true[2]) * math.radians(1.5) == pytest.approx(0.14, abs=0.005)
    shares = [
        too_far(DETECTED["both"][name], TRUTH[name].position) / math.hypot(*TRUTH[name].position)
        for name in POINTS.names
    ]
    assert min(shares) > 0.009
    assert max(shares) < 0.03
    assert off_middle(DETECTED["both"]["wall 3"], TRUTH["wall 3"]) < 0.01
    assert off_middle(DETECTED["both"]["wall 1"], TRUTH["wall 1"]) < 0.01
    assert off_middle(DETECTED["lines"]["wall 3"], TRUTH["wall 3"]) == pytest.approx(
        0.263, abs=1e-3
    )


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


def made(seed=0, by=0.0, without=(), more=(), end=0.0):
    truth = np.zeros((5, 3))
    path = truth + np.array([end, 0.0, 0.0])
    marks = [mark(m, by, i) for i, m in enumerate(true_landmarks()) if m.name not in without]
    return ArenaRun(seed, path, path + 0.5, truth, np.full(5, 2.0), (*marks, *more))


def test_a_perfect_map_has_no_errors():
    result = errors([made()])
    assert result.missing == result.false == result.double == result.corners_missing == ()
    assert set(result.distance) == {*NAMED, END}
    assert all(s.high == pytest.approx(0.0, abs=1e-9) for s in result.distance.values())
    assert result.nees == 2.0
    assert result.within == 1.0


def test_errors_are_those_put_in():
    result = errors([made(0, 0.01, end=0.02)])
    assert all(result.distance[name].median == pytest.approx(0.01) for name in NAMED)
    assert result.distance[END].median == pytest.approx(0.02)


def test_missing_false_and_double_are_told_apart():
    ghost = Landmark(90, "cylinder", np.array([0.0, 0.9]), {}, np.eye(2), None, 9, 0.0, 1.0)
    twice = mark(TRUTH["cylinder 1"], 0.05, 91)
    result = errors(
        [
            made(0),
            made(1, without=["cylinder 2"]),
            made(2, more=[ghost]),
            made(3, more=[twice]),
            made(4, without=CORNERS[:1]),
        ]
    )
    assert (result.missing, result.false, result.double) == ((1,), (2,), (3,))
    assert result.corners_missing == (4,)


def test_a_landmark_missing_in_most_seeds_is_not_left_out_of_the_median():
    result = errors([made(0), made(1, without=["wall 3"]), made(2, without=["wall 3"])])
    assert math.isinf(result.distance["wall 3"].median)
    assert "missing" in str(result.distance["wall 3"])
    json.dumps(result.figures(), allow_nan=False)


def test_landmarks_that_the_experiment_is_not_about_may_be_missing():
    assert errors([made(0, without=NAMED[:4])], POINTS.names).missing == ()


def test_quantiles_by_nearest_rank():
    spread = Spread.of(range(1, 101))
    assert (spread.median, spread.low, spread.high) == (50, 3, 98)


def test_a_too_sure_estimate_is_found_out():
    sure = ArenaRun(0, *(np.zeros((4, 3)),) * 3, np.array([1.0, 2.0, 7.9, 50.0]), ())
    result = errors([sure])
    assert result.within == 0.5
    assert result.nees == pytest.approx(15.225)


def test_the_representative_run_is_the_median_one():
    assert representative([made(s, end=e) for s, e in enumerate((0.3, 0.1, 0.2))]).seed == 2


def test_tables_have_a_row_for_each_landmark_and_the_print_in_metres():
    came = {"default": errors([made(0, 0.01)])}
    table = distance_table(BOTH, came)
    assert [row[0] for row in table.rows] == [*BOTH.names, END]
    assert all(len(row) == len(table.header) for row in table.rows)
    wall = wall_table(LINES, came)
    assert [row[:2] for row in wall.rows] == [
        ["wall 1", "0.122"],
        ["wall 2", "0.014"],
        ["wall 3", "0.263"],
        ["wall 4", "0.135"],
    ]
    assert {row[2] for row in wall.rows} == {"0.010 [0.010, 0.010]"}


def test_the_picture_is_the_same_bytes_each_time():
    pictured = {"one": made(), "lost": made(1, 0.4, without=["wall 1"], end=3.0)}
    png = arena_png(pictured, dpi=40)
    assert png.startswith(b"\x89PNG")
    assert png == arena_png(pictured, dpi=40)


# ------------------------------------------------------------------------------- the runs


def test_seeds_are_chosen_by_their_wheels_alone():
    chosen = drifting(Job(), 2)
    assert chosen == [seed for seed in range(chosen[-1] + 1) if dead_reckoning(seed) >= OFF]


def test_a_run_ends_where_the_wheels_alone_say_it_does_and_is_kept():
    (first,) = runs(Job(), [0], [DEFAULT])[0]
    assert first.wheels == pytest.approx(dead_reckoning(0), abs=1e-9)
    assert first.end < 0.01
    assert errors([first]).missing == errors([first]).false == ()
    assert runs(Job(), [0], [DEFAULT])[0][0] is first


@pytest.mark.slow
def test_the_gate_to_the_letter_loses_the_map_and_the_one_of_squares_keeps_it():
    told = []
    part = arena.points(Job(1, tick=lambda what, done, total: told.append((what, done, total))))
    assert part.name == "points"
    json.dumps(part.figures, allow_nan=False)
    assert part.figures["2_m_gate"]["seeds_missing"] == part.figures["seeds"]
    assert part.figures["thesis"]["distance"][END]["median"] < 0.05
    assert part.figures["default"]["distance"][END]["median"] < 0.01
    assert told
