"""The tables show the scores."""

import math

import numpy as np
import pytest

from impslam.studies.extractor_scores import Counts, Detection
from impslam.studies.extractor_stats import ExtractorScore
from impslam.studies.extractor_tables import accuracy_table, detection_table, numbers
from impslam.sweeps.statistics import mean, rms


def wall(rho, alpha):
    """A wall found with these errors, where the bound is 1 cm and 1 degree, R twice that."""
    bound = np.diag([1e-4, math.radians(1.0) ** 2])
    error = np.array([rho, alpha])
    return Detection(error, 4.0 * bound, bound, math.nan, math.nan, math.nan, 50, 0.8, 2.0)


@pytest.fixture
def scores():
    """Ten scans with two walls each, one of them found, one false observation in all."""
    clean, wrong = Counts(2, 1, 0, 0, 0), Counts(2, 1, 0, 0, 1)
    found = [wall(sign * 0.02, -sign * math.radians(3.0)) for sign in (-1.0, 1.0)] * 5
    some = ExtractorScore.of([(wrong if k == 0 else clean, [f]) for k, f in enumerate(found)])
    none = ExtractorScore.of([(Counts(2, 0, 0, 0, 0), [])])
    return {"good": {"driving": some}, "blind": {"driving": none}}


def cells(table):
    return {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}


def test_what_is_found(scores):
    speeds = {"good": {"driving": 500.0}, "blind": {"driving": 2000.0}}
    table = cells(detection_table("wall", scores, speeds))
    assert table["good"]["found %"] == "50.0"
    assert table["good"]["false/scan"] == "0.10"
    assert table["good"]["÷ fastest"] == "0.25"
    assert table["blind"]["found %"] == "0.0"
    assert table["blind"]["scans/s"] == "2000"


def test_how_well(scores):
    table = cells(accuracy_table("wall", scores))
    assert float(table["good"]["r RMS mm"]) == 20.0
    assert float(table["good"]["α RMS °"]) == 3.0
    assert float(table["good"]["r ÷ CRB"]) == 2.0
    assert float(table["good"]["α ÷ CRB"]) == 3.0
    assert float(table["good"]["own"]) == 1.0
    assert float(table["good"]["used %"]) == 80.0
    assert float(table["good"]["NEES"]) == (4.0 + 9.0) / 4.0
    assert table["good"]["r bias mm"] == "0"  # of two signs: no minus before nothing
    assert set(list(table["blind"].values())[2:]) == {"–"}


def test_numbers_have_errors_and_no_nan(scores):
    found = numbers(scores, {"good": {"driving": 500.0}})
    good, blind = found["good"]["driving"], found["blind"]["driving"]
    assert good["true_positives"]["value"] == 0.5
    assert good["rms_0"]["value"] == pytest.approx(0.02)
    assert good["bias_0"]["error"] == pytest.approx(0.02 / math.sqrt(10 - 1))
    assert good["scans_per_second"] == 500.0
    assert good["true_positives_of_whole"] is None
    assert blind["true_positives"]["value"] == 0.0
    assert "nees" not in blind


def test_one_value_has_no_standard_error():
    for estimate in (mean(np.array([1.0])), rms(np.array([2.0]))):
        assert math.isnan(estimate.error)
    assert mean(np.array([1.0, 3.0])).error == pytest.approx(1.0)
