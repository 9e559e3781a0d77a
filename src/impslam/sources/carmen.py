"""CARMEN text logs: odometry and laser lines of the Carnegie Mellon robot toolkit, also gzipped.

Every line ends with `ipc_timestamp ipc_hostname logger_timestamp`; the first of them is the stamp.
Laser lines contain the odometry pose at which they were taken, except RAWLASER1. Stamps sometimes go
backwards; the order of lines is that of the events.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from impslam.columns import Columns
from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.sources.base import Mount, Stream
from impslam.sources.carmen_lines import line_laser, odometry, raw_laser, robot_laser
from impslam.sources.carmen_mount import laser_mount
from impslam.sources.carmen_shapes import Convert, Shape, read_table, shapes
from impslam.sources.parts import LocatedMessage, Piece, single
from impslam.sources.tables import Lines
from impslam.sources.text import TextSource, head
from impslam.types import Array, Ints, LaserScan, Message, OdometryPose

LASERS = ("FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER")  # in order of preference
_COMMON_COUNTS = (180, 181, 360, 361)  # SICK LMS: 1 deg or 0.5 deg over 180 deg
_NAME = re.compile(rb"#|[A-Z][A-Z0-9_]*\s")
_OPENING = (b"# CARMEN", b"ODOM ", b"PARAM ", b"SYNC ", *(f"{name} ".encode() for name in LASERS))


@register("carmen")
class Carmen(TextSource):
    """CARMEN log: ODOM, FLASER, RLASER, ROBOTLASER1 and RAWLASER1 lines, also .gz."""

    describes_robot: ClassVar[bool] = True

    laser: Literal["auto", "FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER"] = parameter(
        "auto",
        "1",
        "laser lines to use; auto: the first of FLASER, ROBOTLASER1, RAWLASER1, RLASER in the log",
    )
    field_of_view: float = parameter(
        math.pi,
        "rad",
        "angle that FLASER and RLASER beams span, which these lines do not contain",
        gt=0,
        le=2.0 * math.pi,
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by the message names at the start of lines."""
        return any(line.startswith(_OPENING) and _plausible(line) for line in head(path))

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of a block of lines: lines of equal shape as tables, others one by one."""
        del rows  # a block is small
        converters, choice = self._converters(), self._chosen_laser()
        for first, block in self._blocks(self.path):
            lines = Lines(block)
            part: list[Piece] = []
            remaining = np.ones(len(lines), np.bool_)
            for name, convert in converters.items():
                for shape in shapes(lines, name, convert):
                    good, values = read_table(lines, shape)
                    remaining[good] = False
                    part += self._pieces(shape, values, first + good, choice)
            for k in np.flatnonzero(remaining).tolist():
                part += self._read_line(lines.line(k), first + k, converters, choice)
            self._report_guesses(part)
            yield part

    def _pieces(self, shape: Shape, values: Array, places: Ints, choice: str) -> list[Piece]:
        """Return the rows of lines of equal shape, given their numbers."""
        stamps, beams = values[:, -1], shape.beams
        is_odometry = shape.name == "ODOM"
        order = 2 * places + is_odometry
        pieces = []
        # lasers other than the chosen one repeat the same poses
        if shape.pose is not None and (is_odometry or shape.name == choice):
            poses = {"stamp": stamps, "pose": np.ascontiguousarray(values[:, shape.pose :][:, :3])}
            columns = Columns("ODOM", OdometryPose, order, poses, {})
            pieces.append(Piece.of(columns, places, checked=is_odometry))
        if not is_odometry:
            sweeps = {"stamp": stamps, "ranges": np.ascontiguousarray(values[:, :beams])}
            columns = Columns(shape.name, LaserScan, order + 1, sweeps, shape.layout)
            pieces.append(Piece.of(columns, places))
        return pieces

    def _read_line(
        self, line: bytes, number: int, converters: Mapping[str, Convert], choice: str
    ) -> Iterator[Piece]:
        """Yield the rows of any line, or report a problem."""
        name = b"".join(line.split(None, 1)[:1]).decode("ascii", "replace")
        if name not in converters:
            if name and _NAME.match(line + b"\n") is None:
                self._reject(
                    "line", self.path, number, "it does not start with a CARMEN message name"
                )
            return
        try:
            *pose, last = converters[name](line.split())
        except (ValueError, IndexError, MessageError) as error:
            self._reject(name, self.path, number, error)
            return
        if pose and name == choice:
            yield single(LocatedMessage(pose[0], number, "ODOM", checked=False), 2 * number)
        yield single(LocatedMessage(last, number, name), 2 * number + 1)

    def _report_guesses(self, part: Iterable[Piece]) -> None:
        """Report scans with an unusual number of beams, whose angles are a guess."""
        guesses = [
            (columns.order[0], columns["ranges"].shape[1], len(columns))
            for columns, _, _ in part
            if columns.stream in {"FLASER", "RLASER"} and len(columns)
        ]
        for _, beams, count in sorted(guesses):
            if beams not in _COMMON_COUNTS:
                self._problems.add(
                    "guessed beam angles",
                    f"{self.path}: {beams} beams are assumed to span "
                    f"{math.degrees(self.field_of_view):g} deg; set field_of_view if that is wrong",
                    count,
                )

    def _converters(self) -> dict[str, Convert]:
        """Return the functions that read the words of a line, by its name."""
        plain = partial(line_laser, field_of_view=self.field_of_view)
        lasers: dict[str, Convert] = {
            "FLASER": plain, "RLASER": plain, "ROBOTLASER1": robot_laser, "RAWLASER1": raw_laser,
        }  # fmt: skip
        return {"ODOM": odometry} | {laser: lasers[laser] for laser in self._lasers()}

    def _lasers(self) -> list[str]:
        """Return the names of the laser lines to read."""
        choice = self._chosen_laser()
        return [choice, *(name for name in LASERS if name in self.wanted and name != choice)]

    def _chosen_laser(self) -> str:
        """Return the name of the laser lines to use by default."""
        if self.laser != "auto":
            return self.laser
        found: set[bytes] = {line.split(None, 1)[0] for line in head(self.path) if line.strip()}
        return next((name for name in LASERS if name.encode() in found), LASERS[0])

    def streams(self) -> list[Stream]:
        """Return the kinds of line, by name."""
        counts, choice = self._first_words(self.path), self._chosen_laser()
        used, default = {"ODOM", *self._lasers()}, {"ODOM", choice}
        if counts[choice] and choice != "RAWLASER1":  # the others contain poses
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
        """Return the default lines of odometry and scans."""
        return {OdometryPose: "ODOM", LaserScan: self._chosen_laser()}

    def mounts(self) -> Mapping[str, Mount]:
        """Return the mount of the laser of ROBOTLASER1 lines, if their poses determine it."""
        name = "ROBOTLASER1"
        pose = laser_mount(self.path) if name in self._lasers() else None
        return {} if pose is None else {name: Mount(pose, origin=f"the poses in {name}")}


def _note(name: str, choice: str, is_read: bool) -> str:
    """Return the note of `imp inspect` on a kind of line, given the chosen laser."""
    if name == "ODOM":
        return "" if choice == "RAWLASER1" else f"poses, including those in {choice} lines"
    if name not in LASERS or is_read:
        return ""
    return f"not read ({choice} is); use it with source.laser={name}, or name it in source.wanted"


def _plausible(line: bytes) -> bool:
    """Distinguish a CARMEN line from one of another format that starts with the same word."""
    return line.startswith(b"#") or len(line.split()) >= 3


_TYPES = {"ODOM": "OdometryPose", **dict.fromkeys(LASERS, "LaserScan")}
