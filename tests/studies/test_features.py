"""The comparison of features: gains are paired, and intervals come from the drives."""

import numpy as np
import pytest

from impslam.studies.features import Comparison, _bootstrapped, _comparisons, _gain, _printed
from impslam.studies.report import load_text

PAIRED = Comparison("x", ("a", "b"), "points", 0.0)


def rows(errors):
    return {seed: {"foot a": error, "foot b": error} for seed, error in enumerate(errors)}


def test_the_print_says_what_its_distances_say():
    """52, 6, 55 and 28 %, as computed by hand from the positions of Tables 1 to 3."""
    shares = [100.0 * _printed(one) for one in _comparisons(load_text("features"))]
    np.testing.assert_allclose(shares, [52.0, 6.0, 55.0, 28.0], atol=1.0)


def test_half_the_error_is_a_gain_of_half(rng):
    one = rng.uniform(0.5, 1.5, 40)
    gain = _gain(PAIRED, {"points": rows(one), "both": rows(0.5 * one)})
    assert gain.share == pytest.approx(0.5)
    assert (gain.low, gain.high) == pytest.approx(
        (0.5, 0.5)
    )  # paired: the drives' scatter is shared
    assert gain.better == 1.0


def test_intervals_cover_the_truth_and_shrink_with_drives(rng):
    hits, widths = 0, []
    for count in (20, 80):
        for _ in range(60):
            one, both = rng.exponential(1.0, count), rng.exponential(0.8, count)
            _, low, high = _bootstrapped(one, both)
            hits += low <= 0.2 <= high
            widths.append(high - low)
    assert 0.88 < hits / 120 <= 1.0
    assert np.mean(widths[60:]) < 0.65 * np.mean(widths[:60])


def test_a_missing_landmark_is_no_gain():
    gain = _gain(PAIRED, {"points": rows([1.0, 1.0]), "both": rows([0.5, np.inf])})
    assert gain.better == 0.5
    assert not gain.share > 0.0
