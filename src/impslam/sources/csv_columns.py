"""The roles of the columns of a CSV file, from its header or given by the user."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

from impslam.component import near_miss
from impslam.errors import MessageError
from impslam.sources.csv_cells import UNITS, CsvCells, directions, find_beams, is_extra
from impslam.types import Array

Role: TypeAlias = Literal[
    "stamp", "nanosec", "x", "y", "theta", "qx", "qy", "qz", "qw", "left", "right", "speed", "turn_rate",
    "ranges", "angle_min", "angle_step", "time_step", "range_min", "range_max",
]  # fmt: skip

NAMES: dict[Role, tuple[str, ...]] = {
    "stamp": ("stamp", "timestamp", "time", "t"),
    "x": ("pose.position.x", "x", "odom_x"),
    "y": ("pose.position.y", "y", "odom_y"),
    "theta": ("theta", "yaw", "heading", "odom_theta"),
    "qx": ("pose.orientation.x", "qx"),
    "qy": ("pose.orientation.y", "qy"),
    "qz": ("pose.orientation.z", "qz"),
    "qw": ("pose.orientation.w", "qw"),
    "left": ("left", "left_wheel"),
    "right": ("right", "right_wheel"),
    "speed": ("speed", "v", "twist.linear.x"),
    "turn_rate": ("turn_rate", "omega", "twist.angular.z"),
    "angle_min": ("angle_min",),
    "angle_step": ("angle_step", "angle_increment"),
    "time_step": ("time_step", "time_increment"),
    "range_min": ("range_min",),
    "range_max": ("range_max",),
}
"""Names that are recognised in a header, without unit and without a prefix before a dot."""
STAMP_PAIR: dict[Role, tuple[str, ...]] = {
    "stamp": ("sec", "secs", "stamp_sec", "stamp_secs"),
    "nanosec": ("nanosec", "nsecs", "nsec", "stamp_nanosec", "stamp_nsecs", "stamp_nsec"),
}
"""Names of whole seconds and the ns after them, as in `builtin_interfaces/Time` of ROS."""
_BRACKETED = re.compile(r"\s*[\[(]([^\])]*)[\])]$")
MOTIONS: tuple[tuple[Role, ...], ...] = (
    ("x", "y", "theta"),
    ("x", "y", "qx", "qy", "qz", "qw"),
    ("left", "right"),
    ("speed", "turn_rate"),
)
ECHO = "field."
"""How the names of `rostopic echo -p` begin, except that of the first column, %time; both are in ns."""
MAX_SHOWN = 8  # maximum number of columns that a message names


class CsvLayout(NamedTuple):
    """The roles of the columns of a file.

    Attributes
    ----------
    cells : the columns by role
    motion : the roles that are odometry; empty if there is none
    angles : (n,) rad, of the beams; None if each row contains them, or if there are no ranges
    unread : the names of the columns without a role, except `csv_cells.EXTRAS`
    """

    cells: Mapping[Role, CsvCells]
    motion: tuple[Role, ...]
    angles: Array | None
    unread: tuple[str, ...]

    @property
    def has_ranges(self) -> bool:
        """Whether the file has scans; what `rostopic echo` writes of odometry has none."""
        return "ranges" in self.cells


def layout(
    header: Sequence[str], given: Mapping[Role, str], start: float, step: float, *, named: bool
) -> CsvLayout:
    """Return the roles of the columns, given by the user or found by their names.

    Parameters
    ----------
    header : the names of the columns
    given : by role "NAME", or "FIRST:LAST" for ranges, either with "*FACTOR"
    start, step : rad, direction of the first beam and from beam to beam; NaN: from the header
    named : whether the header is that of the file; else columns are numbered

    Raises
    ------
    MessageError
        If the stamp, the ranges or the directions of the beams are not found; the text says what to do.
    """
    cells = {role: _given_cells(header, role, text, named) for role, text in given.items()}
    plain = ["." + _BRACKETED.sub(r"_\1", name.lower()).lstrip("%# ") for name in header]
    for role, names in NAMES.items():
        if role not in cells and (found := _find_by_name(plain, names)):
            cells[role] = found
    pair = {role: _find_by_name(plain, names) for role, names in STAMP_PAIR.items()}
    # A column `stamp` beside them is empty in files of bag2csv.
    if "stamp" not in given and all(pair.values()):
        cells |= {role: one for role, one in pair.items() if one}
    if "nanosec" in cells:
        cells["nanosec"] = cells["nanosec"]._replace(factor=UNITS["ns"])
    if "ranges" not in cells and (beams := find_beams(header)):
        cells["ranges"] = beams
    motion = next((roles for roles in MOTIONS if all(role in cells for role in roles)), ())
    is_echo = any(name.startswith(ECHO) for name in header)
    needed: tuple[Role, ...] = ("stamp",) if motion and is_echo else ("stamp", "ranges")
    for role in needed:
        if role not in cells:
            example = "stamp=NAME" if role == "stamp" else "ranges=FIRST:LAST"
            raise MessageError(
                f"no column for {role} found ({shorten(header)}): name it with --columns {example}"
                + ("" if named else f"; without a header, columns are called 1 to {len(header)}")
            )
    if is_echo and cells["stamp"].factor == 1.0:
        cells["stamp"] = cells["stamp"]._replace(factor=UNITS["ns"])
    angles = _directions(header, cells, start, step, named=named) if "ranges" in cells else None
    return CsvLayout(cells, motion, angles, _unread(header, cells, motion))


def _directions(
    header: Sequence[str], cells: Mapping[Role, CsvCells], start: float, step: float, *, named: bool
) -> Array | None:
    """Return the directions (n,) rad of the beams, or None if each row contains them."""
    first, last, _ = cells["ranges"]
    names = header[first:last] if named else [""] * (last - first)
    angles = directions(names, start, step)
    if angles is None and not ("angle_min" in cells and "angle_step" in cells):
        raise MessageError(
            "the directions of the beams are unknown: give --set source.angle_min=RAD (of the first "
            "beam) and --set source.angle_step=RAD (from beam to beam, counter-clockwise)"
        )
    return angles


def _unread(
    header: Sequence[str], cells: Mapping[Role, CsvCells], motion: Sequence[Role]
) -> tuple[str, ...]:
    """Return the names of columns that are not read; those of incomplete odometry are not."""
    incomplete = {role for roles in MOTIONS for role in roles} - set(motion)
    used = {k for role, (a, b, _) in cells.items() if role not in incomplete for k in range(a, b)}
    return tuple(name for k, name in enumerate(header) if k not in used and not is_extra(name))


def shorten(columns: Sequence[str]) -> str:
    """Return the names of some columns, or of the first of many, for a message."""
    return ", ".join(columns[:MAX_SHOWN]) + (", ..." if len(columns) > MAX_SHOWN else "")


def _given_cells(header: Sequence[str], role: Role, text: str, named: bool) -> CsvCells:
    names, times, factor = text.partition("*")
    first, to, last = names.strip().partition(":")
    if bool(to) != (role == "ranges"):
        form = "FIRST:LAST" if role == "ranges" else "NAME"
        raise MessageError(f"--columns {role}={text}: expected {role}={form} or {form}*FACTOR")
    try:
        by = float(factor) if times else UNITS.get(first.rpartition("_")[2], 1.0)
    except ValueError:
        raise MessageError(f"--columns {role}={text}: {factor!r} is not a number") from None
    begin, end = _find(header, first, named), _find(header, last if to else first, named) + 1
    if end <= begin:
        raise MessageError(f"--columns {role}={text}: {last} is before {first} in the file")
    return CsvCells(begin, end, by)


def _find(header: Sequence[str], name: str, named: bool) -> int:
    name = name.strip()
    if name in header:
        return list(header).index(name)
    if not named:
        raise MessageError(
            f"no column {name!r}; without a header, columns are called 1 to {len(header)}"
        )
    raise MessageError(f"no column {name!r}; {near_miss(name, header, _summary(header))}")


def _summary(header: Sequence[str]) -> list[str]:
    """Return the names of all columns; those of beams, which may be hundreds, as a range at the end."""
    beams = find_beams(header)
    if beams is None:
        return list(header)
    first, last, _ = beams
    return [*header[:first], *header[last:], f"{header[first]} to {header[last - 1]}"]


def _find_by_name(plain: Sequence[str], names: Sequence[str]) -> CsvCells | None:
    """Return the column with the first of some names among those of a header, in lower case after a dot."""
    for name in names:
        for k, column in enumerate(plain):
            stem, _, unit = column.rpartition("_")
            if column.endswith(f".{name}"):
                return CsvCells(k, k + 1, 1.0)
            if stem.endswith(f".{name}") and unit in UNITS:
                return CsvCells(k, k + 1, UNITS[unit])
    return None
