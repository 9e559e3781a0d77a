"""The table of all filters: completeness, and values of its cells."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.studies.worlds import beginning

from impslam.component import components
from impslam.config import load
from impslam.simulation.world import load_world
from impslam.studies import filter_table
from impslam.studies.circle_simulation import HUANG, simulate
from impslam.studies.filter_consistency import BATCH
from impslam.studies.filter_plot import draw_nees
from impslam.studies.filter_scores import score_filters
from impslam.studies.filter_table import FILTERS, KNOWN, circle_row, installed

SHORT = replace(HUANG, steps=85)


def test_every_filter_is_in_it():
    named = {load("imp", [*KNOWN, *given]).filter["kind"] for given in FILTERS.values()}
    kinds = {load("imp", [*KNOWN, *given]).estimator["kind"] for given in FILTERS.values()}
    assert named == set(components("filter"))
    assert kinds == {"landmarks", "particles", "smoothing"}


def test_a_filter_whose_library_is_missing_is_left_out(monkeypatch):
    monkeypatch.setattr(filter_table, "find_spec", lambda name: None)
    assert set(FILTERS) - set(installed()) == {"smoothing"}


@pytest.fixture(scope="module")
def rows():
    made = []
    for run in range(2):
        trial = simulate(SHORT, np.random.default_rng([0, run]))
        for name in ("ekf", "riekf", "FastSLAM 2", BATCH):
            row = circle_row(SHORT, name, trial)
            made.append({"world": "circle", "variant": name, "seed": run, "error": "", **row})
    return made


def test_a_filter_is_compared_with_the_optimum_where_that_is_known(rows):
    found = score_filters(rows, "circle")
    assert found[BATCH].over_optimum == 1.0
    assert math.isnan(found[BATCH].milliseconds)
    for name in ("ekf", "riekf"):
        assert found[name].over_optimum == pytest.approx(1.0, abs=0.1)
    assert 0.5 < found["FastSLAM 2"].over_optimum < 2.0


def test_a_failing_filter_does_not_affect_the_others(rows):
    failed = {"world": "circle", "variant": "ukf", "seed": 0, "error": "no"}
    assert list(score_filters([*rows, failed], "circle")) == list(score_filters(rows, "circle"))


def test_intervals_contain_the_means(rows):
    for found in score_filters(rows, "circle").values():
        assert found.runs == 2
        for cell in (found.nees, found.position):
            assert cell.low <= cell.value <= cell.high
    values = [row["nees"] for row in rows if row["variant"] == "ekf"]
    assert score_filters(rows, "circle")["ekf"].nees.value == pytest.approx(np.mean(values))


def test_the_figure_has_a_panel_for_each_data_set(rows):
    found = score_filters(rows, "circle")
    cells = {data: {name: s.nees for name, s in found.items()} for data in ("one", "two")}
    assert [axes.get_title("left") for axes in draw_nees(cells).axes] == ["one", "two"]


def test_the_section_has_a_table_for_each_data_set(monkeypatch):
    """On the first 10 s of the worlds: what the filters make of whole drives is the study's result."""
    monkeypatch.setattr(filter_table, "FILTERS", {"ekf": FILTERS["ekf"]})
    monkeypatch.setattr(filter_table, "SETTINGS", {"circle": SHORT})
    worlds = [beginning(load_world(name), 10.0) for name in filter_table.WORLDS]
    monkeypatch.setattr(filter_table, "WORLDS", worlds)
    part = filter_table.filter_table(filter_table.Job(seeds=1))
    assert [table.title for table in part.tables] == ["Circle", "Arena", "Corridor"]
    assert [row[0] for row in part.tables[0].rows] == ["ekf", BATCH]
    assert all(row["error"] == "" for row in part.runs)
