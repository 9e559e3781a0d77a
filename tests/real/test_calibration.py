"""Calibration on real logs: what is known of the robots is found."""

import numpy as np
import pytest
from benchmarks.calibration import of_tuples, reference

from impslam.calibration.calibrate import calibrate, extract_drives
from impslam.calibration.recording import record
from impslam.open_log import open_log

pytestmark = pytest.mark.real


def found(log, preset, settings=()):
    """Return the parameters that a log tells, by name."""
    config, source = open_log(log, preset, settings)
    drives = extract_drives(config, record(config, source), str(log))
    return {one.name: one for one in calibrate(config, drives).parameters}


def test_a_simulator_s_true_odometry_and_mount(data_folder):
    """`/odom` of this bag is the truth; the URDF has the lidar at -0.064 m."""
    got = found(data_folder / "turtlebot3" / "turtlebot3.bag", "default")
    assert got["distance_scale"].value == pytest.approx(1.0, abs=0.0014)  # two sigma
    assert got["turn_scale"].value == pytest.approx(1.0, abs=0.002)
    assert got["x"].value == pytest.approx(-0.064, abs=0.003)
    assert got["y"].value == pytest.approx(0.0, abs=0.002)
    assert got["latency"].value == pytest.approx(0.0, abs=0.005)


def test_the_track_of_the_lego_robot(data_folder):
    """Nominal 155 mm; a search on the reference path gives 176 mm, the course's calibration 173."""
    got = found(data_folder / "lego-robot4", "lego-robot4")
    assert 0.166 < got["track"].value < 0.19
    assert abs(got["track"].value - 0.176) < 3.0 * got["track"].sigma


def test_the_latency_of_a_log_that_repeats_poses_with_scans(data_folder):
    """fr079: `imp inspect` finds 0.133 s. With repeated poses at the newest time it was 0.16 s."""
    got = found(data_folder / "fr079" / "fr079.log", None)
    assert got["latency"].value == pytest.approx(0.133, abs=0.005)


def test_stamps_that_run_back_and_forth(data_folder):
    """Over 20 s the path of the scans and odometry agree with 0.963 and 0.986; stamps tell no latency."""
    got = found(data_folder / "intel" / "intel.log", None)
    assert abs(got["distance_scale"].value - 0.963) < 3.0 * np.hypot(
        0.003, got["distance_scale"].sigma
    )
    assert abs(got["turn_scale"].value - 0.986) < 3.0 * np.hypot(0.005, got["turn_scale"].sigma)
    assert got["turn_per_metre"].value == pytest.approx(0.059, abs=0.005)
    assert not got["latency"].observable


def test_the_published_calibration_of_censi(data_folder):
    """A laser at 90 degrees: within the scatter of the published thirds of the data, 2 sigma."""
    folder = data_folder / "calibration"
    values, _ = of_tuples(folder / "l90.tuple")
    thirds = [reference(folder / f"l90_{k}_results.json") for k in range(3)]
    error = np.abs(values - reference(folder / "l90_results.json"))
    assert np.all(error < 2.0 * np.std(thirds, axis=0, ddof=1))
