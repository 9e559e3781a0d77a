"""The car's outdoor logs against GPS and survey. Figures were measured on 2026-11-21."""

import time

import numpy as np
import pytest
from benchmarks.outdoor import carpark, score, victoria_park
from benchmarks.outdoor_calibration import antenna, calibrate, read
from benchmarks.real_logs import run_log

from impslam.columns import messages
from impslam.evaluation.consistency import score_innovations
from impslam.evaluation.trajectory import statistics
from impslam.geometry.kernels import compile_seconds
from impslam.sources.base import recognise
from impslam.types import TruePose

pytestmark = [pytest.mark.real]


@pytest.fixture(scope="module")
def beacons(data_folder):
    return carpark(data_folder)


@pytest.fixture(scope="module")
def timed_trees(data_folder):
    """Return the run and its score, and the seconds of the processor that both took, once compiled."""
    begin, compiled = time.process_time(), compile_seconds()
    made = victoria_park(data_folder)
    return made, time.process_time() - begin - (compile_seconds() - compiled)


@pytest.fixture(scope="module")
def trees(timed_trees):
    return timed_trees[0]


def test_carpark_finds_the_beacons_and_nothing_else(beacons):
    seen, scored = beacons
    assert len(scored.known) == 15
    assert len(scored.beacons.found) == 14
    assert scored.beacons.missing == ("beacon 6",)  # the laser sees it in six scans
    assert scored.beacons.false == scored.beacons.doubles == ()
    assert np.sqrt(np.mean(scored.beacon_errors**2)) < 0.1  # measured 0.062; surveyed to 0.02
    assert len(seen.landmarks) == 14


def test_carparks_map_is_as_sure_as_it_is_right(beacons):
    _, scored = beacons
    nees, (low, high) = scored.nees
    assert low < nees < high  # measured 1.28 in 0.52 to 1.63


def test_carparks_path_is_that_of_the_gps(beacons):
    _, scored = beacons
    path = statistics(scored.errors)
    assert path.count > 620  # of 626 fixes, those between the first and the last scan
    assert path.median < 0.12  # measured 0.076
    assert path.rmse < 0.2  # measured 0.106; 0.7 m at the end of a turn without a beacon in view
    assert statistics(scored.wheels_errors).rmse > 1.2  # measured 1.43


def test_carparks_map_hardly_depends_on_the_calibration_of_its_sensors(data_folder):
    """Without it the map is worse, and as complete: nothing rests on numbers from this log."""
    plain = [
        "odometry.steering_offset=0.0",
        "sensors.lidar.latency=0.0",
        "sensors.lidar.mount=[0.0, 0.0, 0.0]",
    ]
    seen = run_log(data_folder / "carpark", settings=plain)
    scored = score(seen, data_folder / "carpark")
    assert len(scored.beacons.found) >= 14
    assert scored.beacons.false == scored.beacons.doubles == ()
    assert statistics(scored.errors).rmse < 0.3


def test_victoria_parks_path_is_that_of_the_gps(trees):
    seen, scored = trees
    path = statistics(scored.errors)
    assert path.count == 4462  # of 4466: the first is older than the first scan, three are left out
    assert path.median < 1.3  # measured 0.91
    assert np.quantile(scored.errors, 0.9) < 4.0  # measured 2.5
    assert path.rmse < 2.5  # measured 1.59
    assert scored.left_out < 10  # 3, of which one is 137 m off
    assert statistics(scored.wheels_errors).rmse > 40.0  # measured 59
    assert 200 < len(seen.landmarks) < 400  # measured 285


def test_victoria_parks_trees_are_seen_as_precisely_as_the_preset_says(trees):
    innovations = score_innovations(trees[0].known.keyframes.innovations)
    assert 0.6 < innovations.mean < 1.2  # measured 0.75; errors of one side of a trunk repeat


def test_victoria_park_does_not_split_trees(trees):
    """A loop closed in the wrong place would draw trees a second time beside themselves."""
    _, scored = trees
    apart = np.hypot(*(scored.marks[:, None] - scored.marks).T)
    pairs = int((apart < 1.0).sum() - len(scored.marks)) // 2
    assert pairs < 10  # measured 3


def test_the_covariance_is_positive_definite_after_26_minutes(trees):
    seen = trees[0]
    P = seen.known.landmark_covariance
    assert P.shape == (2 * len(seen.landmarks),) * 2
    np.testing.assert_array_equal(P, P.T)
    # Scaled to correlations: the smallest eigenvalue is then not that of the units.
    scale = 1.0 / np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P * np.outer(scale, scale))[0] > 0.0
    np.linalg.cholesky(P)


def test_victoria_park_is_far_faster_than_real_time(timed_trees):
    """By the processor's time: other processes do not count."""
    (seen, _), seconds = timed_trees
    assert seen.outcome.log_seconds / seconds > 20.0


@pytest.mark.parametrize("name", ["carpark", "victoria-park"])
def test_the_antenna_is_at_the_laser(data_folder, name):
    """So base_link is there, and fixes without a heading are its place."""
    log = read(data_folder / name)
    constants, _, _ = calibrate(log)
    place, turns = antenna(log, constants)
    assert turns >= 7
    np.testing.assert_allclose(place, [3.78, 0.5], atol=0.2)  # measured 3.72, 0.50 and 3.67, 0.56
    np.testing.assert_allclose(constants[2:4], [3.78, 0.5], atol=0.15)  # 3.75, 0.48; 3.72, 0.50
    preset = [0.003, 1.0, 3.78, 0.5, -0.018, 0.05]
    np.testing.assert_allclose(constants, preset, atol=0.07)


def test_the_gps_never_reaches_the_filter(data_folder):
    for name in ("carpark", "victoria-park"):
        with recognise(data_folder / name)(path=data_folder / name) as source:
            fixes = [m for m in messages(source.batches()) if isinstance(m, TruePose)]
        assert fixes
        assert all(np.isnan(m.pose[2]) for m in fixes)
