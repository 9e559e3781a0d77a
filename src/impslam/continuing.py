"""Goes on with a map: what of a log is in it already, and how keyframes are numbered on.

A log whose first scans are the last ones of the map, by stamps and odometry, is the one that the map
was made from. It is tracked again up to there, which costs little and leaves the tracker as it was; then
it goes on as if it had never stopped. Any other log begins a session, which has to be found in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.geometry.se2 import between
from impslam.map import Map, Track
from impslam.types import Array


class Known(NamedTuple):
    """A map that a run begins with.

    Attributes
    ----------
    map : it is gone on with, or
    frozen : it stays as it is, and the log is localised in it
    hint : (3,) or (2,) m, m, rad, about where in the map the log begins; None: it is found
    """

    map: Map
    frozen: bool = False
    hint: Array | None = None


SAME_ODOMETRY = 1e-3
"""m and rad; dead reckoning of the same readings differs by rounding, that of two drives by far more. Logs
of simulators begin at the same stamp, and stamps of two robots may count from their start."""

_ROWS = (
    "stamps", "T_anchor_base", "covariance", "odometry", "located", "reasons", "amounts",
)  # fmt: skip
"""Columns of a track."""


class Continuation:
    """Cuts tracks down to what is new, and numbers their keyframes on from those of the map."""

    def __init__(self, known: Known | None = None) -> None:
        self._next = 0 if known is None else len(known.map.keyframes)
        self._shift: int | None = None if self._next else 0
        self._first = 0  # keyframe of the log, where it is in the map
        self._stamps, self._odometry = np.empty(0), np.empty((0, 3))  # of its scans there
        self._start: Array | None = None  # odometry of its first scan, as it comes again
        self._count = 0  # of those that have come again
        self._goes_on = self._waits = (
            False  # where it stopped, or for the first keyframe of a session
        )
        if known is not None and not known.frozen:
            self._remember(known.map)

    def _remember(self, known: Map) -> None:
        """Expect the log that was mapped last."""
        scans = min(len(known.stamps), int(logs_of(known)[-1]["scans"]))
        if scans:
            begin = len(known.stamps) - scans
            self._stamps, self._first = known.stamps[begin:], int(known.anchors[begin])
            odometry = known.odometry_poses[begin:]
            self._odometry = between(odometry[0], odometry)

    @property
    def repeated(self) -> int:
        """Number of scans with which the log goes on where the map ends; 0 of another log."""
        return self._count if self._goes_on else 0

    @property
    def seen(self) -> str:
        """Why nothing of the log is new, "" if that is not so."""
        if self._shift is None and self._count > 0:
            return f"all of its {self._count} scans are in the map already; give another log"
        if self._waits:
            return "it has no keyframe behind the scans that are in the map already"
        return ""

    def rest(self, track: Track) -> Track | None:
        """Return what of a track is new, or None."""
        begin = 0
        if self._shift is None:
            begin = self._repeated(track)
            if begin == len(track.stamps) + (track.keyframe is not None):
                return None
            self._decide(track.anchor + 1)
        return self._numbered(track, begin)

    def _repeated(self, track: Track) -> int:
        """Return how many scans of a track come again, of its first ones."""
        stamps, odometry = track.stamps, track.odometry
        if track.keyframe is not None:
            stamps = np.append(stamps, track.keyframe.stamp)
            odometry = np.concatenate((odometry, track.keyframe.odometry[None]))
        if self._start is None and len(odometry):
            self._start = odometry[0].copy()
        expected = self._stamps[self._count : self._count + len(stamps)]
        n = len(expected)
        same = stamps[:n] == expected
        if n and self._start is not None:
            moved = between(self._start, odometry[:n])
            driven = self._odometry[self._count : self._count + n]
            same &= (np.abs(between(driven, moved)) < SAME_ODOMETRY).all(axis=1)
        count = len(same) if same.all() else int(np.argmin(same))
        self._count += count
        return count

    def _decide(self, keyframes: int) -> None:
        """Decide how it goes on after so many keyframes of the log."""
        self._shift = self._next - keyframes
        same_keyframes = self._shift == self._first
        self._goes_on = 0 < self._count == len(self._stamps) and same_keyframes
        self._waits = not self._goes_on

    def _numbered(self, track: Track, begin: int) -> Track | None:
        """Return a track without its first rows, numbered as in the map."""
        assert self._shift is not None
        if self._shift == 0 and begin == 0 and not self._waits:
            return track
        keyframe = track.keyframe
        if keyframe is not None:
            keyframe = replace(
                keyframe, id=keyframe.id + self._shift, lost=keyframe.lost or self._waits
            )
        if self._waits:
            if keyframe is None:
                return None
            self._waits, begin = False, len(track.stamps)
        return _cut(replace(track, anchor=track.anchor + self._shift, keyframe=keyframe), begin)


def logs_of(known: Map) -> list[dict[str, Any]]:
    """Return the logs that a map is made of, in their order, each with the number of its scans there."""
    about, logs = known.about, known.about.get("logs")
    if isinstance(logs, list) and logs and all(_is_log(log) for log in logs):
        return list(logs)
    names = ("log", "log_sha256")
    return [{name: about.get(name, "") for name in names} | {"scans": len(known.stamps)}]


def _is_log(value: object) -> bool:
    return isinstance(value, dict) and isinstance(value.get("scans"), int)


def begin_with(
    known: Map | str | Path | None, *, frozen: bool = False, hint: Sequence[float] | None = None
) -> Known | None:
    """Return what a run begins with, from what a user gives.

    Raises
    ------
    ImpError
        If the map cannot be read, or there is none to be frozen or hinted at.
    """
    if known is None:
        if frozen or hint is not None:
            raise ConfigError("frozen and hint are about a map; give one to localise in")
        return None
    place = None if hint is None else np.array(hint, float)
    if place is not None and (place.shape not in {(2,), (3,)} or not np.isfinite(place).all()):
        raise ConfigError(f"{hint} is no place in a map; give x,y in m, or x,y,theta with rad")
    if not isinstance(known, Map):
        from impslam.imported_map import GRIDS, load_map  # noqa: PLC0415  few runs need it

        if Path(known).suffix.lower() in GRIDS and not frozen:
            raise ConfigError(
                f"{known}: a grid can be localised in, not gone on with; add --frozen"
            )
        known = load_map(Path(known))
    if frozen and len(known.keyframes) == 0:
        raise ConfigError("the map has no keyframes; nothing can be localised in it")
    return Known(known, frozen, place)


def _cut(track: Track, begin: int) -> Track:
    """Return a track without its first rows."""
    if begin == 0:
        return track
    rows: dict[str, Any] = {name: getattr(track, name)[begin:] for name in _ROWS}
    return replace(track, rows=slice(track.rows.start + begin, track.rows.stop), **rows)
