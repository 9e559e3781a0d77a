"""Writes the run folder: the live path while it is driven, the rest at the end."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.observers.file_by_file import FileByFile
from impslam.observers.run_folder import begin_summary, make_run_folder, write_end
from impslam.observers.trajectory import TrajectoryWriter
from impslam.types import Array, TrueLandmark, TruePose


class Truth(Observer):
    """Keeps the true path."""

    def __init__(self) -> None:
        self._rows = array("d")

    def truth(self, pose: TruePose) -> None:
        """Keep a true pose."""
        self._rows.extend((pose.stamp, *pose.pose))

    @property
    def path(self) -> Array:
        """(m, 4) stamp, x, y, theta (NaN if not told); m = 0 where the log has no truth."""
        return np.array(self._rows, np.float64).reshape(-1, 4)


class Recorder(Truth):
    """Writes a run into a folder, which is made if need be; `known` are the true landmarks.

    Raises
    ------
    ImpError
        If the folder cannot be written to.
    """

    def __init__(self, folder: Path, known: Sequence[TrueLandmark] = ()) -> None:
        super().__init__()
        make_run_folder(folder)
        begin_summary(folder)
        self._folder, self._known = folder, known
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
        """Write what is known only at the end."""
        keep = FileByFile(self._folder)
        for rows in self._live.files:
            with keep(rows.path.name, grows=True):
                rows.flush()
        write_end(keep, known, outcome, self.path, self._known)
