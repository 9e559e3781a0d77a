"""Reads many lines of CARMEN logs at once: those of equal shape as a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.errors import MessageError
from impslam.sources.parts import LocatedMessage, single
from impslam.sources.tables import Lines
from impslam.types import Array, Ints, LaserScan, Message

_LAYOUT_WORDS = {"ODOM": 1, "FLASER": 2, "RLASER": 2, "ROBOTLASER1": 9, "RAWLASER1": 9}
"""Number of words at the start of a line that determine its shape."""
_DESCRIBED = ("ROBOTLASER1", "RAWLASER1")
"""Lines with remissions after the ranges."""
_SHAPES = 8  # maximum number per name and block; some lidars cycle through four start angles
_TAIL = 2  # words after the stamp

Convert: TypeAlias = Callable[[list[bytes]], tuple[Message, ...]]


class Shape(NamedTuple):
    """The layout of lines of one name with the same first words.

    Attributes
    ----------
    prefix : the words that determine the shape, with the blanks between them
    width : number of numbers that follow; the last is the stamp
    pose : index of the first number of the pose; None if there is none
    beams : number of beams; their ranges come first
    remissions : number of remissions, which follows the ranges of some lines
    layout : what the scans share
    """

    name: str
    prefix: bytes
    width: int
    pose: int | None
    beams: int
    remissions: int
    layout: Mapping[str, Any]


def shapes(lines: Lines, name: str, convert: Convert) -> Iterator[Shape]:
    """Yield the shape of the first valid line of each shape."""
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
    layout = single(LocatedMessage(last, 0, name), 0).columns.layout
    beams = len(last.ranges) if isinstance(last, LaserScan) else 0
    width = len(tokens) - words - _TAIL
    pose = {"ODOM": 0, "ROBOTLASER1": width - 9, "RAWLASER1": None}.get(name, beams + 3)
    remissions = int(tokens[words + beams]) if name in _DESCRIBED else 0
    return Shape(name, found[0], width, pose, beams, remissions, layout)


def read_table(lines: Lines, shape: Shape) -> tuple[Ints, Array]:
    """Return which lines are valid and have a shape, and their numbers (k, width)."""
    which = np.flatnonzero(lines.starting(shape.prefix))
    values, good = lines.table(which, len(shape.prefix), shape.width, _TAIL)
    needed = values[:, -1:]
    if shape.pose is not None:
        needed = np.column_stack((needed, values[:, shape.pose :][:, :3]))
    good &= np.isfinite(needed).all(axis=1)
    if shape.name in _DESCRIBED:
        good &= values[:, shape.beams] == shape.remissions
    return which[good], values[good]
