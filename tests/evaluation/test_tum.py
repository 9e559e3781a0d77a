"""Trajectory files: round trip, and errors that name the line."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from impslam.errors import ImpError
from impslam.evaluation.tum import read_tum, write_tum


def test_rows_are_read_in_their_order(tmp_path, rng):
    stamps = np.array([1.5e9 + 0.123456, 3.0, 2.0, 1e-9])
    rows = np.c_[stamps, rng.normal(size=(4, 2)), [0.0, np.pi, -3.0, 1e-9]]
    write_tum(tmp_path / "a.tum", rows)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back[:, 0], stamps)
    np.testing.assert_allclose(back, rows, atol=1e-9, rtol=0)


def test_comments_and_commas_are_understood(tmp_path):
    (tmp_path / "a.tum").write_text("# head\n\n1, 2, 3, 0, 0, 0, 0, 1 # end\n")
    np.testing.assert_array_equal(read_tum(tmp_path / "a.tum"), [[1, 2, 3, 0]])


def test_a_byte_order_mark_is_left_out(tmp_path):
    (tmp_path / "a.tum").write_bytes(b"\xef\xbb\xbf1 2 3 0 0 0 0 1\r\n")
    np.testing.assert_array_equal(read_tum(tmp_path / "a.tum"), [[1, 2, 3, 0]])


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "contains no pose"),
        ("# only\n", "contains no pose"),
        ("1 2 3\n", "line 1.*found 3 numbers"),
        ("1 2 3 0 0 0 0 1\n1 2 3 0 0 0 x 1\n", "line 2.*'x'"),
        ("nan 2 3 0 0 0 0 1\n", "not finite"),
        ("1 2 3 0 0 0 0.1 0.1\n", "quaternion of row 1"),
    ],
)
def test_errors_name_the_problem_and_the_line(tmp_path, text, why):
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(ImpError, match=why):
        read_tum(tmp_path / "a.tum")


def test_a_missing_file_gives_one_line(tmp_path):
    with pytest.raises(ImpError, match="no such file"):
        read_tum(tmp_path / "none.tum")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(tmp_path, data):
    (tmp_path / "a.tum").write_bytes(data)
    with contextlib.suppress(ImpError):
        assert np.isfinite(read_tum(tmp_path / "a.tum")[:, :3]).all()


def test_an_unknown_heading_is_preserved(tmp_path):
    rows = np.array([[1.0, 2.0, 3.0, np.nan], [2.0, 3.0, 4.0, 0.5]])
    write_tum(tmp_path / "a.tum", rows)
    assert "nan" not in (tmp_path / "a.tum").read_text()
    np.testing.assert_allclose(read_tum(tmp_path / "a.tum"), rows, atol=1e-9)


@pytest.mark.parametrize("turn", ["0 0 0 0", "nan nan nan nan", "0 0 nan 1", "-0.0 0 0 0"])
def test_invalid_quaternions_give_an_unknown_heading(tmp_path, turn):
    (tmp_path / "a.tum").write_text(f"1 2 3 0 {turn}\n")
    np.testing.assert_array_equal(read_tum(tmp_path / "a.tum"), [[1, 2, 3, np.nan]])
