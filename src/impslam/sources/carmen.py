"""CARMEN text logs: odometry and laser lines of the Carnegie Mellon robot toolkit, also gzipped.

Every line ends `ipc_timestamp ipc_hostname logger_timestamp`; the first of them is the stamp.
Laser lines carry the odometry pose at which they were taken. Stamps of such logs run backwards
now and then; the order of lines is that of the events.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from impslam.columns import Columns
from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.sources.base import Stream
from impslam.sources.carmen_lines import line_laser, odometry, robot_laser
from impslam.sources.carmen_shapes import Convert, Shape, read_table, shapes
from impslam.sources.parts import Located, Piece, single
from impslam.sources.tables import Lines
from impslam.sources.text import TextSource, head
from impslam.types import Array, Ints, LaserScan, Message, OdometryPose

LASERS = ("FLASER", "ROBOTLASER1", "RLASER")  # in the order of preference
_COMMON_COUNTS = (180, 181, 360, 361)  # SICK LMS: 1 deg or 0.5 deg over 180 deg
_NAME = re.compile(rb"#|[A-Z][A-Z0-9_]*\s")
_OPENING = (b"# CARMEN", b"ODOM ", b"PARAM ", b"SYNC ", *(f"{name} ".encode() for name in LASERS))


@register("carmen")
class Carmen(TextSource):
    """CARMEN log: ODOM, FLASER, RLASER and ROBOTLASER1 lines, also .gz."""

    laser: Literal["auto", "FLASER", "ROBOTLASER1", "RLASER"] = parameter(
        "auto", "1", "laser lines to use; auto takes the front laser, whichever the log has"
    )
    field_of_view: float = parameter(
        math.pi,
        "rad",
        "angle that FLASER and RLASER beams span, which these lines do not say",
        gt=0,
        le=2.0 * math.pi,
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Tell by the names of messages at the start of lines."""
        return any(line.startswith(_OPENING) and _plausible(line) for line in head(path))

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of a block of lines: alike ones as tables, the others one by one."""
        del rows  # a block is small
        read, choice = self._converters(), self._choice()
        for first, block in self._blocks(self.path):
            lines = Lines(block)
            part: list[Piece] = []
            left = np.ones(len(lines), np.bool_)
            for name, convert in read.items():
                for shape in shapes(lines, name, convert):
                    good, values = read_table(lines, shape)
                    left[good] = False
                    part += self._pieces(shape, values, first + good, choice)
            for k in np.flatnonzero(left).tolist():
                part += self._line(lines.line(k), first + k, read, choice)
            self._enter_guesses(part)
            yield part

    def _pieces(self, shape: Shape, values: Array, places: Ints, choice: str) -> list[Piece]:
        """Return the rows of lines that are alike, from the numbers in them."""
        stamps, beams = values[:, -1], shape.beams
        poses = {"stamp": stamps, "pose": np.ascontiguousarray(values[:, shape.pose :][:, :3])}
        is_odometry = shape.name == "ODOM"
        order = 2 * places + is_odometry
        pieces = []
        if is_odometry or shape.name == choice:  # any other laser's would say the same again
            columns = Columns("ODOM", OdometryPose, order, poses, {})
            pieces.append(Piece.of(columns, places, checked=is_odometry))
        if not is_odometry:
            sweeps = {"stamp": stamps, "ranges": np.ascontiguousarray(values[:, :beams])}
            columns = Columns(shape.name, LaserScan, order + 1, sweeps, shape.layout)
            pieces.append(Piece.of(columns, places))
        return pieces

    def _line(
        self, line: bytes, number: int, read: Mapping[str, Convert], choice: str
    ) -> Iterator[Piece]:
        """Yield the rows of any line, or say what is wrong with it."""
        name = b"".join(line.split(None, 1)[:1]).decode("ascii", "replace")
        if name not in read:
            if name and _NAME.match(line + b"\n") is None:
                self._reject("line", self.path, number, "no CARMEN message is called so")
            return
        try:
            *pose, last = read[name](line.split())
        except (ValueError, IndexError, MessageError) as error:
            self._reject(name, self.path, number, error)
            return
        if pose and name == choice:
            yield single(Located(pose[0], number, "ODOM", checked=False), 2 * number)
        yield single(Located(last, number, name), 2 * number + 1)

    def _enter_guesses(self, part: Iterable[Piece]) -> None:
        """Enter scans whose beams span an angle that their lines do not say."""
        guesses = [
            (columns.order[0], columns["ranges"].shape[1], len(columns))
            for columns, _, _ in part
            if columns.stream in {"FLASER", "RLASER"} and len(columns)
        ]
        for _, beams, count in sorted(guesses):
            if beams not in _COMMON_COUNTS:
                self._problems.add(
                    "guessed beam angles",
                    f"{self.path}: {beams} beams taken to span "
                    f"{math.degrees(self.field_of_view):g} deg; set field_of_view if that is wrong",
                    count,
                )

    def _converters(self) -> dict[str, Convert]:
        """Return what reads the words of a line, by its name."""
        plain = partial(line_laser, field_of_view=self.field_of_view)
        lasers: dict[str, Convert] = {"FLASER": plain, "RLASER": plain, "ROBOTLASER1": robot_laser}
        return {"ODOM": odometry} | {laser: lasers[laser] for laser in self._lasers()}

    def _lasers(self) -> list[str]:
        """Return the names of the laser lines that are read."""
        choice = self._choice()
        return [choice, *(name for name in LASERS if name in self.wanted and name != choice)]

    def _choice(self) -> str:
        """Return the name of the laser lines to use where none is named."""
        if self.laser != "auto":
            return self.laser
        found: set[bytes] = {line.split(None, 1)[0] for line in head(self.path) if line.strip()}
        return next((name for name in LASERS if name.encode() in found), LASERS[0])

    def streams(self) -> list[Stream]:
        """Return the kinds of line, by name."""
        counts, choice = self._first_words(self.path), self._choice()
        used, default = {"ODOM", *self._lasers()}, {"ODOM", choice}
        if counts[choice]:
            counts["ODOM"] += counts[choice]
        return [
            Stream(
                name,
                _TYPES.get(name, "text"),
                count,
                name in used,
                _note(name, choice, name in used),
                name in default,
            )
            for name, count in sorted(counts.items())
            if name
        ]

    def defaults(self) -> Mapping[type[Message], str]:
        """Return the lines to use of odometry and of lasers."""
        return {OdometryPose: "ODOM", LaserScan: self._choice()}


def _note(name: str, choice: str, is_read: bool) -> str:
    """Return what `imp inspect` says of a kind of line, where one laser is chosen."""
    if name == "ODOM":
        return f"poses, those of {choice} lines among them"
    if name not in LASERS or is_read:
        return ""
    return f"not read: {choice} is; set source.laser={name} to use it instead, or name it in source.wanted"


def _plausible(line: bytes) -> bool:
    """Tell a CARMEN line from one of another format that opens with the same word."""
    return line.startswith(b"#") or len(line.split()) >= 3


_TYPES = {"ODOM": "OdometryPose", **dict.fromkeys(LASERS, "LaserScan")}
