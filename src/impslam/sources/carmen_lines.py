"""Reads the words of CARMEN lines."""

from __future__ import annotations

from impslam.errors import MessageError
from impslam.sources.text import beam_angles, beam_times, check_finite, numbers
from impslam.types import LaserScan, Message, OdometryPose, range_limits


def line_layout(n: int, field_of_view: float) -> tuple[float, float]:
    """Return start angle and step (rad) of n beams whose line does not contain their angles.

    An odd number spans the whole field of view (181 beams: -90 to +90 deg), an even one omits the last
    beam (180: -90 to +89 deg), as the SICK LMS does.
    """
    return -field_of_view / 2.0, field_of_view / max(n - n % 2, 1)


def _pose(stamp: float, tokens: list[bytes]) -> OdometryPose:
    x, y, theta = map(float, tokens)
    check_finite("stamp or pose", stamp, x, y, theta)
    return OdometryPose(stamp, numbers(tokens))


def _count(tokens: list[bytes], at: int, others: int) -> int:
    """Return the array length given at an index, checked against the length of the line."""
    n = int(tokens[at])
    if n <= 0 or len(tokens) != n + others:
        raise MessageError(f"{len(tokens)} words, which does not match {n} values")
    return n


def line_laser(tokens: list[bytes], field_of_view: float) -> tuple[Message, ...]:
    """Read `FLASER n ranges laser_pose(3) odom_pose(3) ipc_timestamp host logger`."""
    n = _count(tokens, 1, 11)
    stamp = float(tokens[n + 8])
    pose = _pose(stamp, tokens[n + 5 : n + 8])
    angles = beam_angles(n, *line_layout(n, field_of_view))
    return pose, LaserScan(stamp, angles, numbers(tokens[2 : n + 2]), beam_times(n))


def robot_laser(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `ROBOTLASER1 type start fov step max accuracy mode n ranges m remissions ...`.

    It continues with laser_pose(3) robot_pose(3) tv rv, three safety values and the tail.
    """
    scan, after = _described_laser(tokens, 14)
    return _pose(scan.stamp, tokens[after + 3 : after + 6]), scan


def raw_laser(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `RAWLASER1`, which is `ROBOTLASER1` without the poses and all that follows them."""
    scan, _ = _described_laser(tokens, 3)
    return (scan,)


def _described_laser(tokens: list[bytes], others: int) -> tuple[LaserScan, int]:
    """Return the scan of a line with its angles, and the index of the first word after the remissions.

    `others` is the number of words from there to the end, the last three of which are the tail.
    """
    n = int(tokens[8])
    if n <= 0:
        raise MessageError(f"{n} beams")
    after = n + 10 + (_count(tokens, 9 + n, n + 10 + others) if tokens[9 + n] != b"0" else 0)
    if len(tokens) != after + others:
        raise MessageError(f"{len(tokens)} words, which does not match {n} beams")
    stamp, start, span, step, range_max = map(float, (tokens[-3], *tokens[2:6]))
    check_finite("stamp, start angle or resolution", stamp, start, span, step)
    angles = beam_angles(n, start, step or span / max(n - 1, 1))
    _, high = range_limits(0.0, range_max)
    return LaserScan(
        stamp, angles, numbers(tokens[9 : n + 9]), beam_times(n), range_max=high
    ), after


def odometry(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `ODOM x y theta tv rv accel ipc_timestamp host logger`."""
    if len(tokens) != 10:
        raise MessageError(f"{len(tokens)} words instead of 10")
    return (_pose(float(tokens[7]), tokens[1:4]),)
