"""The role of an observer: it looks at a run and cannot slow, break or change it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impslam.trust import TRUSTED, Health
from impslam.types import Array, Landmark, StepResult, TruePose


@dataclass(frozen=True, slots=True)
class Dropped:
    """One kind of problem: how often, and the first example (what, where, what to do)."""

    count: int
    example: str


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a run was, told once at its end.

    Attributes
    ----------
    log : the log's path as the user gave it
    log_sha256 : its hash (of all files, for a folder)
    config : the resolved config, nested plain values as TOML holds them
    counts : messages by type, scans, landmarks
    dropped : what was not used, by kind of problem
    stages : stage -> (n,) seconds it took for each scan ("odometry", "sensor", "associate", ...)
    log_seconds : first to last message in use, steps of the clock left out
    wall_seconds : how long the run took
    landmarks : the final map
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
    landmarks: tuple[Landmark, ...]
    state_size: int
    health: Health = TRUSTED


class Observer:
    """Does nothing: the null observer, and the base of the others."""

    def step(self, result: StepResult) -> None:
        """See one scan's result."""

    def truth(self, pose: TruePose) -> None:
        """See the true pose, where a log carries it; the filter never does."""

    def finish(self, outcome: Outcome) -> None:
        """See the end of the run."""
