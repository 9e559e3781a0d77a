"""Writes the path during the run, so that a run that is cut short leaves its path."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.tum import TRUTH, tum_rows
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.types import Array, TruePose

LIVE_PATH = "trajectory.live.tum"
FLUSH_ROWS = 100
"""Maximum number of rows buffered: 10 s of a lidar at 10 Hz."""


class PoseFile:
    """A text file of poses to append to; it is open only during writes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._pending: list[tuple[Array, Array]] = []
        self._count = 0
        _append(path, "", "w")

    def add(self, stamps: Array, poses: Array) -> None:
        """Append poses (m, 3) at stamps (m,), s."""
        self._pending.append((stamps, poses))
        self._count += len(stamps)
        if self._count >= FLUSH_ROWS:
            self.flush()

    def flush(self) -> None:
        """Write the buffered rows."""
        if self._pending:
            stamps, poses = (np.concatenate(part) for part in zip(*self._pending, strict=True))
            _append(self.path, tum_rows(stamps, poses), "a")
        self._pending.clear()
        self._count = 0


def _append(path: Path, text: str, mode: str) -> None:
    """Write or append to a file; if that fails, leave it unchanged."""
    before = path.stat().st_size if path.exists() else 0
    try:
        with path.open(mode, encoding="utf-8", newline="\n") as stream:
            stream.write(text)
    except OSError as error:
        with suppress(OSError):
            os.truncate(path, before)
        raise ImpError(f"{path}: cannot be written ({error.strerror}); choose another -o") from None


class TrajectoryWriter(Observer):
    """Writes trajectory.live.tum, and truth.tum if the log has ground truth."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = PoseFile(folder / LIVE_PATH)
        self._truth: PoseFile | None = None

    @property
    def files(self) -> list[PoseFile]:
        """The files written so far."""
        return [self._path] if self._truth is None else [self._path, self._truth]

    def follow(self, track: Track, path: PathRows) -> None:
        """Append the poses of a track."""
        del track
        self._path.add(path.stamps, path.poses)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Append the pose at a keyframe."""
        del keyframe, revision
        self._path.add(path.stamps, path.poses)

    def truth(self, pose: TruePose) -> None:
        """Append a true pose."""
        if self._truth is None:
            self._truth = PoseFile(self._folder / TRUTH)
        self._truth.add(np.array([pose.stamp]), pose.pose[None])

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Write the last rows."""
        del known, outcome
        for file in self.files:
            file.flush()
