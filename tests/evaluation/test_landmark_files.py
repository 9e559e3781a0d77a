"""Files of true landmarks: round trip, surveyed lists, and errors that name the landmark."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from impslam.errors import ImpError
from impslam.evaluation.landmark_files import read_true_landmarks, write_true_landmarks
from impslam.simulation.world import load_world


def read(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    return read_true_landmarks(tmp_path / "a.csv")


@pytest.mark.parametrize("world", ["arena", "room"])
def test_landmarks_of_a_world_are_preserved(tmp_path, world):
    known = load_world(world).landmarks()
    write_true_landmarks(tmp_path / "a.csv", known)
    back = read_true_landmarks(tmp_path / "a.csv")
    assert [(t.name, t.kind) for t in back] == [(t.name, t.kind) for t in known]
    for ours, theirs in zip(back, known, strict=True):
        np.testing.assert_allclose(ours.position, theirs.position, atol=1e-12)
        assert ours.parameters == pytest.approx(dict(theirs.parameters), abs=1e-12)
        if theirs.end_points is None:
            assert ours.end_points is None
        else:
            np.testing.assert_array_equal(ours.end_points, theirs.end_points)


def test_a_surveyed_list_is_read(tmp_path):
    points = read(tmp_path, "x,y,remark\n1,2,tree\n3,4.5,pole\n")
    assert [(t.name, t.kind, *t.position) for t in points] == [
        ("1", "point", 1.0, 2.0),
        ("2", "point", 3.0, 4.5),
    ]
    (wall,) = read(tmp_path, "\ufeffname,x1,y1,x2,y2\nnorth,-1,2,3,2\n")
    assert (wall.name, wall.kind) == ("north", "wall")
    np.testing.assert_allclose(wall.position, [0.0, 2.0], atol=1e-15)
    assert wall.parameters == pytest.approx({"r": 2.0, "alpha": np.pi / 2})


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "contains no landmark"),
        ("x,y\n", "contains no landmark"),
        ("x,y\n1,2\n1\n", "landmark 2: y is missing"),
        ("x,y\n1,up\n", "landmark 1: .*'up'"),
        ("x,y\n1,nan\n", "landmark 1: nan is not finite"),
        ("kind,x,y\nwall,1,2\n", "landmark 1: x1 is missing"),
        ("x1,y1,x2,y2\n1,2,1,2\n", "landmark 1: its end points coincide"),
        ("name,x,y\na,1,2\na,2,3\n", "two landmarks are called 'a'"),
        ("1 2 3\n4 5 6\n", "landmark 1: x is missing"),
    ],
)
def test_errors_name_the_problem_and_the_landmark(tmp_path, text, why):
    with pytest.raises(ImpError, match=why):
        read(tmp_path, text)


def test_a_world_without_landmarks_is_preserved(tmp_path):
    path = tmp_path / "truth.landmarks.csv"
    write_true_landmarks(path, [])
    assert read_true_landmarks(path) == []


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(ImpError, match="no such file"):
        read_true_landmarks(tmp_path / "none.csv")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(tmp_path, data):
    (tmp_path / "a.csv").write_bytes(b"x,y\n" + data)
    with contextlib.suppress(ImpError):
        assert all(np.isfinite(t.position).all() for t in read_true_landmarks(tmp_path / "a.csv"))
