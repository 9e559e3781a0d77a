"""The role of an observer: it receives the tracks, revisions and map of a run, and must not change them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impslam.component import shorten
from impslam.errors import ConfigError, ImpError, in_a_line
from impslam.health import NO_SCANS, Health
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.types import Array, TruePose


@dataclass(frozen=True, slots=True)
class Dropped:
    """A kind of problem: its count and first example (what, where, what to do)."""

    count: int
    example: str


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Facts about a run besides its `Map`.

    Attributes
    ----------
    log : path of the log as given by the user
    log_sha256 : its hash (of all files, for a folder)
    config : the resolved config as nested plain values
    counts : messages by type, scans, landmarks, and loops tried and closed if the estimator closes loops
    dropped : unused data by kind of problem
    stages : durations in s by stage: "sense" of each batch, "track" of the sweeps up to each keyframe,
        "extract" and "estimate" of each keyframe, and once "refine"
    log_seconds : from the first to the last used message, corrected for clocks that were set;
        NaN if the stamps are unusable
    wall_seconds : duration of the run, s
    compile_seconds : part of it spent compiling, in the first run of a version
    state_size : number of scalars in the filter state at the end
    health : whether the pose can be trusted, for each scan
    lidar_alone : whether the run had no odometry
    partial : why the run is incomplete and where in the log it ended, "" if it is complete
    """

    log: Path
    log_sha256: str
    config: Mapping[str, Any]
    counts: Mapping[str, int]
    dropped: Mapping[str, Dropped]
    stages: Mapping[str, Array]
    log_seconds: float
    wall_seconds: float
    state_size: int
    health: Health = NO_SCANS
    lidar_alone: bool = False
    partial: str = ""
    compile_seconds: float = 0.0


def require_placed(path: Path, known: Map) -> None:
    """Raise `ImpError` if no scan of the run is located in the map, so that a file has nothing to show."""
    if not known.placed().any():
        raise ImpError(f"{path}: not written, because no scan is located in the map")


class Observer:
    """Base class of observers; does nothing.

    The arrays of tracks, keyframes, revisions and paths are read-only. Those of a keyframe's sweeps, scan
    and observations are not, because kernels are compiled for writable arrays: never write to them.
    """

    def follow(self, track: Track, path: PathRows) -> None:
        """Receive a track and the current estimate of its sweeps' poses in map."""

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Receive a keyframe, its revision, and the pose at the keyframe's stamp (one row)."""

    def truth(self, pose: TruePose) -> None:
        """Receive a true pose from the log; the estimator never does."""

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Receive the map at the end of the run, even if it ended early (`outcome.partial`)."""


def finish_all(observers: Iterable[Observer], known: Map, outcome: Outcome) -> None:
    """Pass the map to all observers; raise the first error of one only after the others have finished."""
    errors: list[Exception] = []
    for observer in observers:
        try:
            observer.finish(known, outcome)
        except Exception as error:
            errors.append(error)
    if errors:
        for another in errors[1:]:
            errors[0].add_note(in_a_line(another))
        raise errors[0]


def checked_observers(observers: Iterable[Observer]) -> list[Observer]:
    """Return a user's observers as a list; raise `ConfigError` if they are not `Observer` objects."""
    given = list(observers) if isinstance(observers, Iterable) else None
    if given is None or not all(isinstance(one, Observer) for one in given):
        raise ConfigError(f"observers = {shorten(observers)}: expected a list of Observer")
    return given
