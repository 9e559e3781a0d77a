"""Writes the run folder: the live path during the run, the other files at the end."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.observers.run_folder import begin_summary, make_run_folder, write_end
from impslam.observers.trajectory import TrajectoryWriter
from impslam.observers.write_attempts import WriteAttempts
from impslam.types import Array, TrueLandmark, TruePose


class TruthRecorder(Observer):
    """Keeps the true path."""

    def __init__(self) -> None:
        self._rows = array("d")

    def truth(self, pose: TruePose) -> None:
        """Keep a true pose."""
        self._rows.extend((pose.stamp, *pose.pose))

    @property
    def path(self) -> Array:
        """(m, 4) stamp, x, y, theta (NaN if unknown); m = 0 if the log has no ground truth."""
        return np.array(self._rows, np.float64).reshape(-1, 4)


class Recorder(TruthRecorder):
    """Writes a run to a folder, created if needed, with the true landmarks, if any.

    Raises
    ------
    ImpError
        If the folder cannot be written to.
    """

    def __init__(self, folder: Path, true_landmarks: Sequence[TrueLandmark] = ()) -> None:
        super().__init__()
        make_run_folder(folder)
        begin_summary(folder)
        self._folder, self._true_landmarks = folder, true_landmarks
        self._live = TrajectoryWriter(folder)

    def follow(self, track: Track, path: PathRows) -> None:
        """Write the live path."""
        self._live.follow(track, path)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Write the live path."""
        self._live.revise(keyframe, revision, path)

    def truth(self, pose: TruePose) -> None:
        """Write a true pose."""
        super().truth(pose)
        self._live.truth(pose)

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Write the remaining files."""
        attempt = WriteAttempts(self._folder)
        for file in self._live.files:
            with attempt(file.path.name, keep_partial=True):
                file.flush()
        write_end(attempt, known, outcome, self.path, self._true_landmarks)
