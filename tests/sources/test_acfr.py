"""The ACFR car's MATLAB logs: what comes when, what is dropped, what is refused."""

import math

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from tests.sources.logs import assert_same, read, write_acfr_carpark, write_acfr_park

from impslam.columns import messages
from impslam.errors import SourceError
from impslam.sources.base import recognise
from impslam.sources.matlab import variables
from impslam.types import Detections, LaserScan, Steering, TruePose

NAN = math.nan


def edit(path, **changes):
    """Write a MATLAB file again with other variables; None takes one out."""
    table = {name: value for name, value in loadmat(path).items() if name[0] != "_"}
    table |= changes
    with path.open("wb") as file:
        savemat(file, {name: value for name, value in table.items() if value is not None})


@pytest.fixture
def carpark(tmp_path):
    return write_acfr_carpark(tmp_path / "log")


@pytest.fixture
def park(tmp_path):
    return write_acfr_park(tmp_path / "park")


# --------------------------------------------------------------------------- car park


def test_carpark_comes_in_the_order_of_its_events(carpark):
    messages, source = read(carpark)
    assert [(type(m).__name__, m.stamp) for m in messages] == [
        ("Steering", 1.0),
        ("TruePose", 1.125),
        ("LaserScan", 1.25),
        ("Steering", 1.375),
        ("LaserScan", 1.5),
        ("TruePose", 1.625),
        ("Steering", 1.75),
    ]
    assert_same(messages[3], Steering(1.375, 0.75, 0.125))
    assert_same(messages[1], TruePose(1.125, np.array([4.0, -2.0, NAN])))
    assert source.problems.counts == {}


def test_carpark_scans_run_from_right_to_left_with_intensities(carpark):
    scan = [m for m in read(carpark)[0] if isinstance(m, LaserScan)][1]
    assert len(scan.ranges) == 361
    np.testing.assert_allclose(np.degrees(scan.angles[[0, 180, 360]]), [-90.0, 0.0, 90.0])
    assert np.flatnonzero(scan.intensities).tolist() == [180, 181]
    assert scan.range_max < 81.91  # which means no echo


def test_events_of_unknown_sensors_or_missing_readings_are_dropped(carpark):
    edit(carpark, Sensor=[[2, 7, 3, 2, 3, 1, 2]], Index=[[1, 1, 9, 0, 2, 2, 3]])
    messages, source = read(carpark)
    assert [m.stamp for m in messages] == [1.0, 1.5, 1.625, 1.75]
    assert source.problems.counts == {"malformed event": 3}
    assert source.problems.examples["malformed event"].endswith(
        "log:2: no sensor 7 has a reading 1; dropped"
    )


def test_non_finite_readings_are_dropped(carpark):
    edit(carpark, Velocity=[[0.5, NAN, 1.0]], GPSLon=[[np.inf, 4.5]], TimeLaser=[[1.25, NAN]])
    messages, source = read(carpark)
    assert [m.stamp for m in messages] == [1.0, 1.25, 1.625, 1.75]
    assert source.problems.counts == {"malformed event": 3}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"Velocity": [[0.5, 1.0]]}, "lengths differ"),
        ({"Index": [[1, 1]]}, "lengths differ"),
        ({"TimeLaser": [[1.0]]}, "different sizes"),
        ({"Intensity": np.zeros((2, 360))}, "different sizes"),
        ({"Steering": "left"}, "not a row of numbers"),
        ({"Laser": np.zeros((2, 3), complex)}, "not a table of numbers"),
    ],
)
def test_an_inconsistent_carpark_is_a_one_line_error(carpark, changes, why):
    edit(carpark, **changes)
    with pytest.raises(SourceError, match=f"{carpark}: [^\n]*{why}[^\n]*copy it again$"):
        read(carpark)


def test_the_survey_beside_the_log_gives_true_landmarks(carpark):
    assert recognise(carpark)(path=carpark).true_landmarks() == []
    survey = carpark.with_name("survey.mat")
    savemat(survey, {"estbeac": [[1.0, 2.0], [NAN, 3.0], [4.0, 5.0]]})
    with recognise(carpark)(path=carpark) as source:
        known = source.true_landmarks()
        assert source.streams()[-1].count == 2
    assert [(k.name, k.kind, *k.position) for k in known] == [
        ("beacon 1", "point", 1.0, 2.0),
        ("beacon 3", "point", 4.0, 5.0),
    ]


def test_a_folder_is_read_like_its_file(carpark):
    carpark.rename(carpark.with_suffix(".mat"))
    savemat(carpark.with_name("a_survey.mat"), {"estbeac": [[1.0, 2.0]]})
    messages, source = read(carpark.parent)
    assert len(messages) == 7
    assert len(source.true_landmarks()) == 1


def test_a_file_without_a_variable_is_not_recognised(carpark):
    edit(carpark, Intensity=None)
    with pytest.raises(SourceError, match="no known log format"):
        recognise(carpark)


# --------------------------------------------------------------------------- park


def test_parks_streams_are_merged_by_their_stamps(park):
    messages, source = read(park)
    assert [(type(m).__name__, m.stamp) for m in messages] == [
        ("Steering", 1.0),
        ("TruePose", 1.125),
        ("Detections", 1.125),
        ("Steering", 1.25),
        ("Detections", 1.25),
        ("Steering", 1.5),
        ("TruePose", 1.5),
        ("Detections", 1.625),
        ("Steering", 1.75),
    ]
    assert_same(messages[5], Steering(1.5, 2.0, 0.25))
    assert_same(messages[6], TruePose(1.5, np.array([4.5, -2.25, NAN])))
    assert source.problems.counts == {}
    assert source.position == source.total == 9


def test_tree_bearings_are_relative_to_straight_ahead(park):
    trees, none, _ = (m for m in read(park)[0] if isinstance(m, Detections))
    np.testing.assert_allclose(trees.ranges, [8.0, 16.0])
    np.testing.assert_allclose(trees.bearings, [0.5 - math.pi / 2, 2.0 - math.pi / 2])
    np.testing.assert_allclose(trees.diameters, [0.25, 0.75])
    assert trees.labels.tolist() == [-1, -1]
    assert len(none.ranges) == 0


def test_a_park_without_gps_is_read(park):
    (park / "gps.mat").unlink()
    with recognise(park)(path=park) as source:
        assert not any(isinstance(m, TruePose) for m in messages(source.batches()))
        assert [s.type for s in source.streams()] == ["Steering", "Detections"]


def test_the_parks_file_finds_the_gps_beside_it(park):
    messages, _ = read(park / "log.mat")
    assert sum(isinstance(m, TruePose) for m in messages) == 2


def test_bad_rows_of_the_park_are_dropped(park):
    cells = np.empty(3, object)
    cells[:] = [np.ones((2, 4)), np.array(["tree"]), np.ones((3, 2))]
    u = np.array([[1.0, NAN, 2.0, 0.0], [0.0, 0.125, 0.25, np.inf]])
    edit(park / "log.mat", zt=cells, u=u)
    messages, source = read(park)
    assert [m.stamp for m in messages if isinstance(m, Steering)] == [1.0, 1.5]
    assert [m.stamp for m in messages if isinstance(m, Detections)] == [1.625]
    assert source.problems.counts == {"malformed wheels": 2, "malformed trees": 2}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"u": np.zeros((2, 3))}, "u is not two rows"),
        ({"u": np.zeros((3, 4))}, "u is not two rows"),
        ({"TLsr": [[1.0, 2.0]]}, "lengths differ"),
    ],
)
def test_an_inconsistent_park_is_a_one_line_error(park, changes, why):
    edit(park / "log.mat", **changes)
    with pytest.raises(SourceError, match=f"log.mat: [^\n]*{why}[^\n]*copy it again$"):
        read(park)


def test_other_files_have_no_matlab_variables(tmp_path, carpark):
    text = tmp_path / "text.mat"
    text.write_text("Time Sensor Index")
    assert variables(text) == variables(tmp_path) == frozenset()
    assert {"Time", "Laser"} <= variables(carpark)
    carpark.write_bytes(carpark.read_bytes()[:130])
    assert variables(carpark) == frozenset()
