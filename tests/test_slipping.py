"""Wheels that slip for 10 s in a simulated building: the pose follows the scans."""

from pathlib import Path

from benchmarks.health import BUILDING, fail


def test_wheels_that_report_twice_the_motion_do_not_spoil_the_map():
    """The robot enters a corridor then, which few of the 120 beams have seen before."""
    result = fail((Path(), BUILDING, "wheels slip, twice the way", 11))
    assert result.worst < 0.1  # m; the position along the corridor was lost without the wider prior
    assert result.said > 0.5
    assert result.silent == 0


def test_wheels_that_report_half_of_the_motion_do_not_take_the_map_along():
    """In the same corridor; scans pulled away by odometry once lost their weight against it for good."""
    result = fail((Path(), BUILDING, "wheels slip, half of the way", 11))
    assert result.worst < 0.5  # m; 4.0 m if only the share at the fused pose counted
    assert result.silent == 0
