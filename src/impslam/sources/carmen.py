"""CARMEN text logs: odometry and laser lines of the Carnegie Mellon robot toolkit, also gzipped.

Every line ends `ipc_timestamp ipc_hostname logger_timestamp`; the first of them is the stamp.
Laser lines carry the odometry pose at which they were taken. Stamps of such logs run backwards
now and then; the order of lines is that of the events.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.sources.base import Stream
from impslam.sources.parts import Located
from impslam.sources.text import TextSource, beam_angles, beam_times, finite, head, numbers
from impslam.types import LaserScan, Message, OdometryPose

LASERS = ("FLASER", "ROBOTLASER1", "RLASER")  # in the order of preference
_COMMON_COUNTS = (180, 181, 360, 361)  # SICK LMS: 1 deg or 0.5 deg over 180 deg
_NAME = re.compile(rb"#|[A-Z][A-Z0-9_]*\s")
_OPENING = (b"# CARMEN", b"ODOM ", b"PARAM ", b"SYNC ", *(f"{name} ".encode() for name in LASERS))


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

    def _messages(self) -> Iterator[Located]:
        choice = self._choice().encode()
        read: dict[bytes, Callable[[list[bytes]], tuple[Message, ...]]] = {b"ODOM": _odometry}
        for laser in self._lasers():
            is_robot = laser == "ROBOTLASER1"
            read[laser.encode()] = self._robot_laser if is_robot else self._line_laser
        for number, line in self._lines(self.path):
            tokens = line.split()
            if not tokens:
                continue
            convert = read.get(tokens[0])
            try:
                if convert is not None:
                    *pose, last = convert(tokens)
                    if pose and tokens[0] == choice:  # any other laser's would say the same again
                        yield Located(pose[0], number, "ODOM", checked=False)
                    yield Located(last, number, tokens[0].decode())
                elif _NAME.match(line) is None:
                    self._reject("line", self.path, number, "no CARMEN message is called so")
            except (ValueError, IndexError, MessageError) as error:
                self._reject(tokens[0].decode(), self.path, number, error)

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

    def _line_laser(self, tokens: list[bytes]) -> tuple[Message, ...]:
        """Read `FLASER n ranges laser_pose(3) odom_pose(3) ipc_timestamp host logger`."""
        n = _count(tokens, 1, 11)
        stamp = float(tokens[n + 8])
        pose = _pose(stamp, tokens[n + 5 : n + 8])
        if n not in _COMMON_COUNTS:
            self._problems.add(
                "guessed beam angles",
                f"{self.path}: {n} beams taken to span {math.degrees(self.field_of_view):g} deg; "
                "set field_of_view if that is wrong",
            )
        angles = beam_angles(n, *line_layout(n, self.field_of_view))
        return pose, LaserScan(stamp, angles, numbers(tokens[2 : n + 2]), beam_times(n))

    def _robot_laser(self, tokens: list[bytes]) -> tuple[Message, ...]:
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


def _odometry(tokens: list[bytes]) -> tuple[Message, ...]:
    """Read `ODOM x y theta tv rv accel ipc_timestamp host logger`."""
    if len(tokens) != 10:
        raise MessageError(f"{len(tokens)} words instead of 10")
    return (_pose(float(tokens[7]), tokens[1:4]),)


def _plausible(line: bytes) -> bool:
    """Tell a CARMEN line from one of another format that opens with the same word."""
    return line.startswith(b"#") or len(line.split()) >= 3


_TYPES = {"ODOM": "OdometryPose", **dict.fromkeys(LASERS, "LaserScan")}
