"""The lower hull of arrivals, and the closest line below them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.platform.devices.lower_hull import edge_at_mean, lower_hull

HEIGHTS = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=40)


@given(HEIGHTS)
def test_the_lower_hull_is_convex_and_below_all_points(heights):
    points = [(float(x), y) for x, y in enumerate(heights)]
    hull = lower_hull(points)
    xs, ys = np.array(hull).T
    assert np.all(np.interp(np.arange(len(points)), xs, ys) <= np.array(heights) + 1e-9)
    if len(hull) > 2:
        assert np.all(np.diff(np.diff(ys) / np.diff(xs)) >= -1e-9)
    assert set(hull) <= set(points)


@given(HEIGHTS.filter(lambda heights: len(heights) > 1))
def test_the_edge_gives_the_highest_line_below_all_points(heights):
    xs, ys = np.arange(len(heights), dtype=float), np.array(heights)
    (x0, y0), (x1, y1) = edge_at_mean(list(zip(xs, ys, strict=True)))
    assert x0 <= xs.mean() <= x1
    slope = (y1 - y0) / (x1 - x0)
    assert np.all(y0 + slope * (xs - x0) <= ys + 1e-9)
    at_mean = y0 + slope * (xs.mean() - x0)
    for other in slope + np.linspace(-1.0, 1.0, 9):
        assert np.min(ys - other * xs) + other * xs.mean() <= at_mean + 1e-9


@pytest.mark.parametrize("points", [[(1.0, 2.0)], [(1.0, 2.0), (1.0, 1.0)]])
def test_points_of_one_abscissa_have_no_edge(points):
    assert edge_at_mean(points) is None
