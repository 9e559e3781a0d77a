"""The lines of CARMEN logs: what their words are, one by one, and many alike at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.errors import MessageError
from impslam.sources.parts import Located, single
from impslam.sources.tables import Lines
from impslam.sources.text import beam_angles, beam_times, finite, numbers
from impslam.types import Array, Ints, LaserScan, Message, OdometryPose

_LAYOUT_WORDS = {"ODOM": 1, "FLASER": 2, "RLASER": 2, "ROBOTLASER1": 9}
"""How many words of a line say how it goes on."""
_SHAPES = 8  # of a name in one block; some lidars start at one of four angles in turn
_TAIL = 2  # words behind the stamp

Convert: TypeAlias = Callable[[list[bytes]], tuple[Message, ...]]


def line_layout(n: int, field_of_view: float) -> tuple[float, float]:
    """Return start angle and step (rad) of n beams that say nothing about themselves.

    An odd number spans the field of view from edge to edge (181 beams: -90 to +90 deg), an even
    one leaves out the last (180: -90 to +89 deg), which is how the SICK LMS is read out.
    """
    return -field_of_view / 2.0, field_of_view / max(n - n % 2, 1)


def _pose(stamp: float, tokens: list[bytes]) -> OdometryPose:
    x, y, theta = map(float, tokens)
    finite("stamp or pose", stamp, x, y, theta)
    return OdometryPose(stamp, numbers(tokens))


def _count(tokens: list[bytes], at: int, others: int) -> int:
    """Return the array length said at an index, checked against the length of the line."""
    n = int(tokens[at])
    if n <= 0 or len(tokens) != n + others:
        raise MessageError(f"{len(tokens)} words, which does not fit {n} values")
    return n


class Shape(NamedTuple):
    """How lines of one name with the same first words are read at once.

    Attributes
    ----------
    prefix : the name and the other words that say how such a line goes on, with the blanks between
    width : how many numbers follow, the last of them the stamp
    pose : the first of the pose among them
    beams : how many there are, whose ranges come first
    remissions : what the number behind the ranges of ROBOTLASER1 is
    layout : what scans share
    """

    name: str
    prefix: bytes
    width: int
    pose: int
    beams: int
    remissions: int
    layout: Mapping[str, Any]


def shapes(lines: Lines, name: str, convert: Convert) -> Iterator[Shape]:
    """Learn from the first sound line of each shape how to read those like it."""
    waiting = lines.starting(f"{name} ".encode())
    for _ in range(_SHAPES):
        if not waiting.any():
            return
        k = int(waiting.argmax())
        waiting[k] = False
        shape = _shape(lines.line(k), name, convert)
        if shape is not None:
            waiting &= ~lines.starting(shape.prefix)
            yield shape


def _shape(line: bytes, name: str, convert: Convert) -> Shape | None:
    tokens, words = line.split(), _LAYOUT_WORDS[name]
    try:
        *_, last = convert(tokens)
    except (ValueError, IndexError, MessageError):
        return None
    found = re.match(rb"(?:\S+\s+){%d}" % words, line)
    if found is None:
        return None
    layout = single(Located(last, 0, name), 0).columns.layout
    beams = len(last.ranges) if isinstance(last, LaserScan) else 0
    width, bright = len(tokens) - words - _TAIL, name == "ROBOTLASER1"
    pose = {"ODOM": 0, "ROBOTLASER1": width - 9}.get(name, beams + 3)
    remissions = int(tokens[words + beams]) if bright else 0
    return Shape(name, found[0], width, pose, beams, remissions, layout)


def read_table(lines: Lines, shape: Shape) -> tuple[Ints, Array]:
    """Return which lines are sound and have a shape, and the numbers in them (k, width)."""
    which = np.flatnonzero(lines.starting(shape.prefix))
    values, good = lines.table(which, len(shape.prefix), shape.width, _TAIL)
    with np.errstate(invalid="ignore", over="ignore"):
        x, y, theta = values[:, shape.pose :].T[:3]
        good &= np.isfinite(values[:, -1] + x + y + theta)
    if shape.name == "ROBOTLASER1":
        good &= values[:, shape.beams] == shape.remissions
    return which[good], values[good]


def line_laser(tokens: list[bytes], field_of_view: float) -> tuple[Message, ...]:
    """Read `FLASER n ranges laser_pose(3) odom_pose(3) ipc_timestamp host logger`."""
    n = _count(tokens, 1, 11)
    stamp = float(tokens[n + 8])
    pose = _pose(stamp, tokens[n + 5 : n + 8])
    angles = beam_angles(n, *line_layout(n, field_of_view))
    return pose, LaserScan(stamp, angles, numbers(tokens[2 : n + 2]), beam_times(n))


def robot_laser(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `ROBOTLASER1 type start fov step max accuracy mode n ranges m remissions ...`.

    What follows is laser_pose(3) robot_pose(3) tv rv and three safety figures, then the tail.
    """
    n = int(tokens[8])
    if n <= 0:
        raise MessageError(f"{n} beams")
    after = _count(tokens, 9 + n, n + 24) + n + 10 if tokens[9 + n] != b"0" else n + 10
    if len(tokens) != after + 14:
        raise MessageError(f"{len(tokens)} words, which does not fit {n} beams")
    stamp = float(tokens[after + 11])
    pose = _pose(stamp, tokens[after + 3 : after + 6])
    start, span, step, range_max = map(float, tokens[2:6])
    finite("start angle or resolution", start, span, step)
    step = step or span / max(n - 1, 1)
    angles = beam_angles(n, start, step)
    ranges = numbers(tokens[9 : n + 9])
    return pose, LaserScan(stamp, angles, ranges, beam_times(n), range_max=range_max)


def odometry(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `ODOM x y theta tv rv accel ipc_timestamp host logger`."""
    if len(tokens) != 10:
        raise MessageError(f"{len(tokens)} words instead of 10")
    return (_pose(float(tokens[7]), tokens[1:4]),)
