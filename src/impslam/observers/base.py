"""The role of an observer: it looks at a run and cannot slow, break or change it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.types import Array, TruePose


@dataclass(frozen=True, slots=True)
class Dropped:
    """One kind of problem: how often, and the first example (what, where, what to do)."""

    count: int
    example: str


@dataclass(frozen=True, slots=True)
class Health:
    """At how many scans the pose was not to be trusted, the first time and why, and why at the end."""

    doubted: int = 0
    stamp: float = float("nan")
    first: str = ""
    at_end: str = ""

    @property
    def words(self) -> str:
        """What to tell whoever reads the run's results, in one line."""
        if not self.doubted:
            return "to be trusted throughout"
        said = (
            f"not to be trusted at {self.doubted} scans, first at {self.stamp:.3f} s: {self.first}"
        )
        return said + (
            f"; at the end: {self.at_end}" if self.at_end else "; trusted again at the end"
        )


TRUSTED = Health()


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a run was, told once at its end; what it has learned is the `Map`.

    Attributes
    ----------
    log : the log's path as the user gave it
    log_sha256 : its hash (of all files, for a folder)
    config : the resolved config, nested plain values as TOML holds them
    counts : messages by type, scans, keyframes, landmarks
    dropped : what was not used, by kind of problem
    stages : stage -> seconds it took each time ("sense", "track", "look", "estimate")
    log_seconds : first to last message in use, steps of the clock left out
    wall_seconds : how long the run took
    state_size : number of scalars in the belief at the end
    health : whether the robot knew where it was
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
    health: Health = TRUSTED


class Observer:
    """Does nothing: the null observer, and the base of the others."""

    def follow(self, track: Track, path: PathRows) -> None:
        """See a track, and its sweeps' poses in map as they are known at the time."""

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """See what a keyframe has taught, and the pose at its stamp (one row)."""

    def truth(self, pose: TruePose) -> None:
        """See the true pose, where a log carries it; the filter never does."""

    def finish(self, known: Map, outcome: Outcome) -> None:
        """See the map at the end of the run."""
