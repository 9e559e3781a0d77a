"""What every extractor keeps, whatever scan it is shown."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.recorded import perfect

from impslam.component import components
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.world import load_world
from impslam.types import LaserScan

EXTRACTORS = sorted(components("extractor"))
LIDAR = Lidar2D(range_min=0.02, range_max=5.6, sigma_per_m=0.003, bias=0.003)
BAD = [0.0, np.nan, np.inf, -np.inf, -1.0, 0.019, 5.7, 1e300]


def make(name):
    return components("extractor")[name]()


def ready(angles, ranges, twist=(0.0, 0.0, 0.0)):
    angles, ranges = np.asarray(angles, dtype=float), np.asarray(ranges, dtype=float)
    n = len(ranges)
    bright = np.where(np.arange(n) % 10 < 2, 8192.0, 0.0)  # for those that go by brightness
    message = LaserScan(1.0, angles, ranges, 1e-4 * np.arange(n), intensities=bright)
    return LIDAR.scan(message, np.array(twist))


def extract(name, scan, seed=1):
    """Run an extractor and check all that its role promises."""
    found = make(name).extract(scan, np.random.default_rng(seed))
    models = {kind: cls() for kind, cls in components("landmark").items()}
    for o in found:
        model = models[o.kind]
        assert o.z.shape == (model.dim_z,)
        assert o.R.shape == (model.dim_z, model.dim_z)
        assert np.isfinite(o.z).all()
        assert np.isfinite(o.R).all()
        np.testing.assert_allclose(o.R, o.R.T, rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(o.R)[0] > 0.0
        assert o.beams.dtype == np.int64
        assert len(set(o.beams.tolist())) == len(o.beams)
        assert ((o.beams >= 0) & (o.beams < len(scan.ranges))).all()
        if o.end_points is not None:
            assert o.end_points.shape == (2, 2)
            assert np.isfinite(o.end_points).all()
            assert np.ptp(o.end_points, axis=0).any()
        assert all(np.isfinite(value) for value in o.attributes.values())
    return found


def same(one, two):
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert a.kind == b.kind
        np.testing.assert_array_equal(a.z, b.z)
        np.testing.assert_array_equal(a.R, b.R)
        np.testing.assert_array_equal(a.beams, b.beams)


@pytest.fixture(scope="module")
def room():
    """A scan of a room with two cylinders, with range noise."""
    scan = next(m for m in perfect(load_world("room")) if isinstance(m, LaserScan))
    noise = np.random.default_rng(5).normal(0.0, 0.004, len(scan.ranges))
    return ready(scan.angles, scan.ranges + noise * (scan.ranges > 0))


@pytest.mark.parametrize("name", EXTRACTORS)
def test_the_same_scan_and_seed_give_the_same_answer(name, room):
    same(extract(name, room), extract(name, room))


@pytest.mark.parametrize("name", EXTRACTORS)
def test_what_is_found_is_of_the_kind_it_says(name, room):
    cls = components("extractor")[name]
    assert {o.kind for o in extract(name, room)} <= {cls.landmark}
    assert cls.landmark in components("landmark")


@pytest.mark.parametrize("name", EXTRACTORS)
def test_the_scan_is_left_as_it_was(name, room):
    before = {f: getattr(room, f).copy() for f in ("ranges", "points", "valid", "directions")}
    extract(name, room)
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(room, key), value)


@pytest.mark.parametrize("name", EXTRACTORS)
@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
def test_scans_of_a_few_beams(name, n):
    extract(name, ready(np.linspace(-1.0, 1.0, n), np.full(n, 2.0)))


@pytest.mark.parametrize("name", EXTRACTORS)
@pytest.mark.parametrize("value", BAD)
def test_nothing_is_found_where_no_beam_is_valid(name, value):
    assert extract(name, ready(np.linspace(-2.0, 2.0, 100), np.full(100, value))) == []


@pytest.mark.parametrize("name", EXTRACTORS)
@pytest.mark.parametrize(
    "angles",
    [
        np.linspace(2.0, -2.0, 400),  # clockwise
        np.linspace(0.0, 2.0 * np.pi, 360),  # a full turn from 0, both ends the same
        np.linspace(-np.pi, np.pi, 1024, endpoint=False),
        np.zeros(50),  # one direction
        np.linspace(0.0, 1e-6, 50),
    ],
    ids=["clockwise", "0 to 2 pi", "-pi to pi", "one direction", "nearly one"],
)
def test_any_order_and_span_of_angles(name, angles):
    """Of a round room, and of a square one."""
    n = len(angles)
    extract(name, ready(angles, np.full(n, 3.0)))
    square = 2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    extract(name, ready(angles, square, twist=(0.5, 0.0, 1.0)))


RANGES = st.lists(
    st.one_of(st.floats(0.02, 5.6), st.sampled_from(BAD), st.just(2.0)), min_size=0, max_size=120
)


@pytest.mark.parametrize("name", EXTRACTORS)
@settings(max_examples=40, deadline=None)
@given(ranges=RANGES, span=st.floats(0.01, 2 * np.pi), seed=st.integers(0, 99))
def test_any_ranges(name, ranges, span, seed):
    scan = ready(np.linspace(-span / 2, span / 2, len(ranges)), ranges)
    same(extract(name, scan, seed), extract(name, scan, seed))


@pytest.mark.parametrize("name", EXTRACTORS)
@settings(max_examples=15, deadline=None)
@given(pieces=st.lists(st.tuples(st.floats(0.1, 5.5), st.integers(1, 60)), max_size=8))
def test_any_steps(name, pieces):
    """Arcs about the laser with jumps between them: edges, gaps and thin things."""
    ranges = np.concatenate([[], *(np.full(n, r) for r, n in pieces)])
    extract(name, ready(np.linspace(-2.0, 2.0, len(ranges)), ranges))


def test_extractors_together_find_what_each_finds_alone(room):
    """What they share of a scan depends on the scan alone, not on who came before."""
    for order in (EXTRACTORS, EXTRACTORS[::-1]):
        shared = replace(room)
        assert shared.derived == {}
        for name in order:
            same(extract(name, shared), extract(name, replace(room)))
        assert shared.derived
