"""Continue a map: skip the scans of a log that are in it already, and continue its keyframe ids.

If the first scans of a log equal the last ones of the map, by stamps and odometry, the map was made from
this log. These scans are tracked again, which is fast and restores the state of the tracker. The run then
continues as if it had never stopped, even if its keyframes differ from those of the map. Other logs begin
a session, which must be located in the map. Two logs of a simulator are equal in this sense until the
robot has moved, so such scans are held back and not dropped.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impslam.component import shorten
from impslam.errors import ConfigError, SourceError
from impslam.geometry.kernels import plain
from impslam.geometry.se2 import between, compose, compose_uncertain, inverse
from impslam.map import Map, Track
from impslam.observers.base import Outcome
from impslam.provenance import fingerprint
from impslam.sources.base import Problems
from impslam.types import Array, Mask


class KnownMap(NamedTuple):
    """A map that a run continues.

    Attributes
    ----------
    map : the map
    frozen : whether the map does not change, and the log is only localised in it
    hint : (3,) or (2,) m, m, rad, approximate start of the log in the map; None: search everywhere
    """

    map: Map
    frozen: bool = False
    hint: Array | None = None


ODOMETRY_TOLERANCE = 1e-3
"""m and rad; dead reckoning of the same readings differs by rounding, of two drives by far more. Stamps
alone do not identify a log: simulators begin at the same stamp, and clocks of robots at their start."""

CONCLUSIVE = 1.0
"""m or rad; two drives that began at the same stamps differ by more than `ODOMETRY_TOLERANCE` after this
motion: wheels repeat a metre to no better than some millimetres."""

_EQUAL = (
    "the first scans have the stamps and the odometry of scans in the map, and are not used; the later "
    "ones differ, so this is another log than that of the map"
)
_PENDING = (
    "could not be located in the map; its scans are kept in map.imp but are not part of the map: "
    "continue the map with a log that drives from known places into this one"
)

_ROWS = (
    "stamps", "T_anchor_base", "covariance", "odometry", "located", "reasons", "amounts",
)  # fmt: skip
"""Columns of a track."""


class Continuation:
    """Cuts tracks down to their new part, and continues the keyframe ids of the map."""

    def __init__(self, known: KnownMap | None = None) -> None:
        self._next_id = 0 if known is None else len(known.map.keyframes)
        self._id_shift: int | None = None if self._next_id else 0
        self._stamps, self._odometry = np.empty(0), np.empty((0, 3))  # scans of that log in the map
        self._start: Array | None = None  # odometry of the first scan of this run's log
        self._count = 0  # scans that are in the map already
        self._enough = 1  # of them, those that cover conclusive motion
        self._held: list[Track] = []  # their tracks, until the motion is conclusive
        self._is_same_log = False
        self._awaits_keyframe = False  # the first one of a new session
        self._map = None if known is None else known.map
        self._frozen = known is not None and known.frozen
        self._row = -1  # of the newest scan that is in the map, in its track
        # that scan among those of the log, its pose relative to the newest repeated keyframe, and whether
        # it is the scan of that keyframe
        self._newest: tuple[int, Array, bool] | None = None
        self._T_known_newest: Array | None = None  # from the map's newest keyframe, if they differ
        if known is not None and not self._frozen:
            self._expect(known.map)

    def _expect(self, known: Map) -> None:
        """Store the scans of the log that was mapped last, to compare with."""
        scans = min(len(known.stamps), int(logs_of(known)[-1]["scans"]))
        if scans:
            begin = len(known.stamps) - scans
            self._stamps = known.stamps[begin:]
            odometry = known.odometry_poses[begin:]
            self._odometry = between(odometry[0], odometry)
            is_far = (np.abs(self._odometry) > CONCLUSIVE).any(axis=1)
            self._enough = int(np.argmax(is_far)) + 1 if is_far.any() else scans + 1

    def logs(self, outcome: Outcome, scans: int) -> list[dict[str, Any]]:
        """Return the logs of the map, each with the number of its scans in the map; `scans` are new."""
        new = {"log": outcome.log.name, "log_sha256": outcome.log_sha256, "scans": scans}
        if self._map is None:
            return [new]
        before = logs_of(self._map)
        if self._frozen:
            return [*before, {**new, "scans": 0}]
        if self.repeated:
            return [*before[:-1], {**new, "scans": self.repeated + scans}]
        return [*before, new]

    @property
    def repeated(self) -> int:
        """Number of scans of the log that are in the map already; 0 for another log."""
        return self._count if self._is_same_log else 0

    @property
    def unused(self) -> int:
        """Number of first scans of another log that are not used, because they equal those of the map.

        0 if the robot moved too little during these scans to tell two logs apart: then they are used.
        """
        is_other_log = self._id_shift is not None and not self._is_same_log
        return self._count if is_other_log and self._is_conclusive else 0

    @property
    def _is_conclusive(self) -> bool:
        """Whether the robot has moved enough during the scans in the map to identify the log."""
        return self._count >= self._enough

    @property
    def refusal(self) -> str:
        """Why the log adds nothing to the map, or ""."""
        if self._id_shift is None and self._count > 0:
            return f"all of its {self._count} scans are in the map already; give another log"
        if self._awaits_keyframe:
            return "it has no keyframe after the scans that are in the map already"
        return ""

    def report(self, log: Path, known: Map, sessions: int, problems: Problems) -> None:
        """Record scans that are not used, and `sessions` that were not located in the map.

        Raises
        ------
        SourceError
            If there is no other session.
        """
        if not known.placed().any():
            raise SourceError(
                f"{log}: could not be located in the map; give its approximate start with --start "
                "x,y, or a log with some 10 m of driving inside the mapped area"
            )
        if unused := self.unused:
            problems.add("scans of the map", _EQUAL, unused)
        if sessions:
            problems.add("session", _PENDING, sessions)

    def new_parts(self, track: Track) -> Iterator[Track]:
        """Yield the new part of a track, after the tracks that were held back before it."""
        begin = 0
        if self._id_shift is None:
            begin = self._repeated(track)
            if self._is_conclusive:
                self._held.clear()
            if begin == len(track.stamps) + (track.keyframe is not None):
                self._hold(track)
                return
            self._is_same_log = 0 < self._count == len(self._stamps)
            if self._is_same_log:
                self._held.clear()
            elif not self._is_conclusive:
                begin = 0
            self._decide((self._held or [track])[0].anchor + 1)
        for one, rows in [*((held, 0) for held in self._held), (track, begin)]:
            part = self._numbered(one, rows)
            if part is not None:
                yield part
        self._held.clear()

    def _hold(self, track: Track) -> None:
        """Hold back a track whose scans are all in the map already, unless that is conclusive."""
        keyframe, row = track.keyframe, self._row
        if keyframe is not None and row == len(track.stamps):
            self._newest = self._count - 1, keyframe.T_keyframe_stamp, True
        elif keyframe is not None:  # it is not in the map
            before = None if self._newest is None else self._newest[:2]
            if row >= 0:
                before = self._count - 1, track.T_anchor_base[row]
            if before is not None:
                scan, T = before
                self._newest = scan, between(keyframe.motion.d_pose, T), False
        if not self._is_conclusive:
            self._held.append(track)

    def _repeated(self, track: Track) -> int:
        """Return how many of the first scans of a track are in the map already."""
        stamps, odometry = track.stamps, track.odometry
        if track.keyframe is not None:
            stamps = np.append(stamps, track.keyframe.stamp)
            odometry = np.concatenate((odometry, track.keyframe.odometry[None]))
        if self._start is None and len(odometry):
            self._start = odometry[0].copy()
        expected = self._stamps[self._count : self._count + len(stamps)]
        n = len(expected)
        is_same = stamps[:n] == expected
        if n:
            is_same &= self._is_driven(odometry[:n], slice(self._count, self._count + n))
        count = len(is_same) if is_same.all() else int(np.argmin(is_same))
        self._count += count
        self._row = count - 1
        while count < len(stamps) and self._has(float(stamps[count]), odometry[count]):
            if stamps[count] == self._stamps[self._count - 1]:
                self._row = count
            count += 1
        return count

    def _is_driven(self, odometry: Array, at: slice) -> Mask:
        """Return whether odometry (m, 3) is that of some scans of the map."""
        assert self._start is not None  # that of the first scan
        moved = between(self._start, odometry)
        difference = np.abs(between(self._odometry[at], moved))
        return np.asarray((difference < ODOMETRY_TOLERANCE).all(axis=1))

    def _has(self, stamp: float, odometry: Array) -> bool:
        """Return whether the map has a scan later than those so far, or one before and one after it.

        Scans are missing in a map or in a log if a computer was too slow for them.
        """
        begin = self._count
        later = self._stamps[begin:]
        if begin == 0 or not len(later):
            return False
        at = begin + int(np.argmax(later == stamp))
        if self._stamps[at] != stamp:
            return bool(self._stamps[begin - 1] < stamp < later[0])
        if not self._is_driven(odometry[None], slice(at, at + 1)).all():
            return False
        self._count = at + 1
        return True

    def _decide(self, keyframes: int) -> None:
        """Continue the map's ids after the first `keyframes` keyframes, which are in the map already."""
        self._id_shift = self._next_id - keyframes
        self._awaits_keyframe = not self._is_same_log
        if self._is_same_log and self._map is not None and self._newest is not None:
            self._T_known_newest = _from_newest(self._map, len(self._stamps), *self._newest)

    def _numbered(self, track: Track, begin: int) -> Track | None:
        """Return a track without its first `begin` rows, with the keyframe ids of the map."""
        assert self._id_shift is not None
        if self._id_shift == 0 and begin == 0 and not self._awaits_keyframe:
            return track
        if self._T_known_newest is not None:
            track = _from(self._T_known_newest, track)
            if track.keyframe is not None:
                self._T_known_newest = None
        keyframe = track.keyframe
        if keyframe is not None:
            keyframe = replace(
                keyframe,
                id=keyframe.id + self._id_shift,
                lost=keyframe.lost or self._awaits_keyframe,
            )
        if self._awaits_keyframe:
            if keyframe is None:
                return None
            self._awaits_keyframe, begin = False, len(track.stamps)
        return _cut(replace(track, anchor=track.anchor + self._id_shift, keyframe=keyframe), begin)


def _from_newest(
    known: Map, scans: int, scan: int, T_keyframe_stamp: Array, is_own: bool
) -> Array | None:
    """Return the motion (3,) from a map's newest keyframe to one of another gate.

    One of the last `scans` scans is at `T_keyframe_stamp` (3,) relative to that; `is_own` if it is the scan
    of that keyframe. None if both are the same.
    """
    row, newest = len(known.stamps) - scans + scan, len(known.keyframes) - 1
    anchor = int(known.anchors[row])
    if is_own and anchor == newest and known.keyframes.stamps[newest] == known.stamps[row]:
        return None
    T = np.zeros(3)
    for k in range(anchor + 1, newest + 1):
        T = compose(T, known.keyframes.motions[k])
    return between(T, compose(known.tracked[row], inverse(T_keyframe_stamp)))


def _from(T: Array, track: Track) -> Track:
    """Return a track relative to another keyframe, from which its own is at T (3,).

    The covariances stay those from its own one: the keyframes are less than a metre apart.
    """
    none, keyframe = np.zeros((3, 3)), track.keyframe
    if keyframe is not None:
        motion = keyframe.motion
        moved = plain(motion.d_pose), plain(motion.covariance)
        d_pose, covariance = compose_uncertain(T, none, *moved)
        motion = replace(motion, d_pose=d_pose, covariance=covariance)
        keyframe = replace(keyframe, motion=motion)
    moved = plain(track.T_anchor_base), plain(track.covariance)
    poses, covariances = compose_uncertain(T, none, *moved)
    return replace(track, T_anchor_base=poses, covariance=covariances, keyframe=keyframe)


def same_scans(one: Map, other: Map) -> int:
    """Return the number of scans with equal stamps in two maps, if their odometry is equal as well; else 0.

    0 if the robot moved too little during these to tell two drives apart.
    """
    _, i, j = np.intersect1d(one.stamps, other.stamps, return_indices=True)
    if not len(i):
        return 0
    driven = between(one.odometry_poses[i[0]], one.odometry_poses[i])
    difference = between(driven, between(other.odometry_poses[j[0]], other.odometry_poses[j]))
    is_same = np.abs(difference).max() < ODOMETRY_TOLERANCE and np.abs(driven).max() > CONCLUSIVE
    return len(i) if is_same else 0


def logs_of(known: Map) -> list[dict[str, Any]]:
    """Return the logs of a map in their order, each with the number of its scans in the map."""
    about, logs = known.about, known.about.get("logs")
    if isinstance(logs, list) and logs and all(_is_log(log) for log in logs):
        return list(logs)
    names = ("log", "log_sha256")
    return [{name: about.get(name, "") for name in names} | {"scans": len(known.stamps)}]


def mapped_logs(logs: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the logs with scans in the map by their hash; those without a hash are left out."""
    return {log["log_sha256"]: log for log in logs if log["scans"] and log.get("log_sha256")}


def refuse_earlier(begin: KnownMap, log: Path) -> None:
    """Raise `SourceError` if the map to continue has scans of a log, and of another log after it.

    Only the log that was mapped last can be continued; another one would be mapped twice.
    """
    earlier = {} if begin.frozen else mapped_logs(logs_of(begin.map)[:-1])
    if found := earlier and earlier.get(fingerprint(log)):
        raise SourceError(
            f"{log}: {found['scans']} scans of it are in the map already; give another log"
        )


def _is_log(value: object) -> bool:
    return isinstance(value, dict) and isinstance(value.get("scans"), int)


def begin_with(
    known: Map | str | Path | None, *, frozen: bool = False, hint: Sequence[float] | None = None
) -> KnownMap | None:
    """Return the map that a run continues, from a user's arguments; None without one.

    Raises
    ------
    ImpError
        If the map cannot be read, or `frozen` or `hint` are given without a map.
    """
    if known is None:
        if frozen or hint is not None:
            raise ConfigError("frozen and hint need a map; give one to localise in")
        return None
    place = None if hint is None else _place(hint)
    if not isinstance(known, Map | str | Path):
        raise ConfigError(f"known = {shorten(known)}: expected a Map, or the path of its file")
    if not isinstance(known, Map):
        from impslam.imported_map import GRIDS, load_map  # noqa: PLC0415  few runs need it

        if Path(known).suffix.lower() in GRIDS and not frozen:
            raise ConfigError(
                f"{known}: a grid can only be localised in, not continued; add --frozen"
            )
        known = load_map(Path(known))
    if frozen and len(known.keyframes) == 0:
        raise ConfigError("the map has no keyframes; nothing can be localised in it")
    return KnownMap(known, frozen, place)


def _place(hint: Sequence[float]) -> Array:
    """Return a user's approximate place in a map, (2,) or (3,)."""
    try:
        place = np.array(hint, float)
    except (TypeError, ValueError):
        place = np.empty(0)
    if place.shape not in {(2,), (3,)} or not np.isfinite(place).all():
        raise ConfigError(
            f"{shorten(hint)} is not a pose in a map; give x,y or x,y,theta in m and rad"
        )
    return place


def _cut(track: Track, begin: int) -> Track:
    """Return a track without its first `begin` rows."""
    if begin == 0:
        return track
    rows: dict[str, Any] = {name: getattr(track, name)[begin:] for name in _ROWS}
    return replace(track, rows=slice(track.rows.start + begin, track.rows.stop), **rows)
