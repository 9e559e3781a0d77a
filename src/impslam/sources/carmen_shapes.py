"""Many lines of CARMEN logs at once: those that go on alike are read as a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.errors import MessageError
from impslam.sources.parts import Located, single
from impslam.sources.tables import Lines
from impslam.types import Array, Ints, LaserScan, Message

_LAYOUT_WORDS = {"ODOM": 1, "FLASER": 2, "RLASER": 2, "ROBOTLASER1": 9}
"""How many words of a line say how it goes on."""
_SHAPES = 8  # of a name in one block; some lidars start at one of four angles in turn
_TAIL = 2  # words behind the stamp

Convert: TypeAlias = Callable[[list[bytes]], tuple[Message, ...]]


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
