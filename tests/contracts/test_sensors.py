"""What every sensor guarantees: rows are independent, spans are queried once, arguments do not change."""

import math

import numpy as np
import pytest
from tests.odometry_steps import stacked

from impslam.columns import Sweeps
from impslam.component import components
from impslam.types import Detections, Fix, LaserScan, SatelliteFix

TWISTS = np.array([[0.5, 0.0, 0.8], [0.4, 0.1, -1.0], [0.0, 0.0, 0.0], [-0.3, 0.0, 0.1]])
SETTINGS = {"lidar2d": {"period": 0.1, "latency": 0.02, "mount": (0.1, 0.0, 0.3)}}


def message(consumes, k):
    """Return the k-th message; the last one is of no use."""
    stamp, rng = 5.0 + 0.1 * k + 0.01 * (k % 2), np.random.default_rng(k)
    bad = k == len(TWISTS)
    if consumes is LaserScan:
        n = 0 if bad else 30
        angles, offsets = np.linspace(-1.0, 1.0, n), 1e-3 * np.arange(n)
        return LaserScan(stamp, angles, rng.uniform(1.0, 3.0, n), offsets)
    if consumes is Fix:
        place = np.full(2, math.nan) if bad else np.array([20.0 * k, 3.0])
        return Fix(stamp, place, 4.0 * np.eye(2))
    if consumes is SatelliteFix:
        place = (math.nan, math.nan, math.nan) if bad else (50.0 + 2e-4 * k, 8.0, 100.0)
        return SatelliteFix(stamp, *place, 4.0 * np.eye(3), -1 if bad else 0)
    ranges = np.full(3, math.nan) if bad else rng.uniform(1.0, 3.0, 3)
    labels, unknown = np.arange(3), np.full(3, math.nan)
    return Detections(stamp, ranges, rng.normal(0.0, 0.3, 3), labels, unknown)


@pytest.fixture(params=sorted(components("sensor")))
def make(request):
    """Return what makes a sensor: it may keep a clock, so that each run needs a fresh one."""
    return lambda: components("sensor")[request.param](**SETTINGS.get(request.param, {}))


def rows_of(sensor):
    return stacked(message(sensor.consumes, k) for k in range(len(TWISTS)))


def swept(sensor, columns, twists):
    begins, ends = sensor.spans(columns)
    middles, nothing = 0.5 * (begins + ends), np.zeros((len(columns), 3))
    assert ((begins <= ends) & np.isfinite(begins)).all()
    scans = sensor.sweeps(columns, twists)
    covariance = np.zeros((len(columns), 3, 3))
    return Sweeps("s", columns, middles, twists, nothing, covariance, scans)


def plain(sweeps, k, found):
    scan = sweeps.scan(k)
    arrays = [sweeps.middles[k : k + 1]]
    if scan is not None:
        arrays += [scan.ranges, scan.valid, scan.points, scan.directions, scan.origins, scan.sigmas]
    for o in found:
        arrays += [o.z, o.R, o.beams]
    return [array.tobytes() for array in arrays]


def test_any_cutting_gives_the_same_bytes(make):
    found = []
    for cut in (1, 3, len(TWISTS)):
        sensor, rows = make(), []
        columns = rows_of(sensor)
        for k in range(0, len(TWISTS), cut):
            part = slice(k, k + cut)
            sweeps = swept(sensor, columns.take(part), TWISTS[part])
            for i in range(len(sweeps)):
                looked = sensor.observe(sweeps, i, np.random.default_rng(k + i))
                rows.append(plain(sweeps, i, looked))
        found.append(rows)
    assert found[0] == found[1] == found[2]


def test_arguments_do_not_change(make):
    sensor = make()
    columns, twists = rows_of(sensor), TWISTS.copy()
    before = {name: column.copy() for name, column in columns.values.items()}
    sweeps = swept(sensor, columns, twists)
    sensor.observe(sweeps, 1, np.random.default_rng(0))
    for name, column in before.items():
        np.testing.assert_array_equal(columns.values[name], column)
    np.testing.assert_array_equal(twists, TWISTS)


def test_an_unusable_row_is_described_in_one_line(make):
    sensor = make()
    assert sensor.usable(rows_of(sensor)).all()
    bad = message(sensor.consumes, len(TWISTS))
    assert not sensor.usable(stacked([bad])).any()
    assert f"{bad.stamp:.3f} s" in sensor.fault(bad)
    assert "\n" not in sensor.fault(bad)


def test_a_stream_has_a_name_and_rows_a_type(make):
    sensor = make()
    assert sensor.stream == ""
    assert rows_of(sensor).kind is sensor.consumes
