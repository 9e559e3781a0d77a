"""Writes the path while it is driven: memory stays flat, and a run cut short leaves its path."""

from __future__ import annotations

from pathlib import Path

from impslam.errors import ImpError
from impslam.evaluation.tum import PATH_COLUMNS, TRUTH, tum_row
from impslam.observers.base import Observer, Outcome
from impslam.types import StepResult, TruePose

FLUSH = 100
"""Rows kept back at most: 10 s of a lidar at 10 Hz."""


class Rows:
    """A text file that grows by rows; it is open only while it is written to."""

    def __init__(self, path: Path, header: str = "") -> None:
        self.path = path
        self._pending: list[str] = []
        _append(path, header, "w")

    def add(self, row: str) -> None:
        """Append a row, line end included."""
        self._pending.append(row)
        if len(self._pending) >= FLUSH:
            self.flush()

    def flush(self) -> None:
        """Write what is pending."""
        _append(self.path, "".join(self._pending), "a")
        self._pending.clear()


def _append(path: Path, text: str, mode: str) -> None:
    try:
        with path.open(mode, encoding="utf-8", newline="\n") as stream:
            stream.write(text)
    except OSError as error:
        raise ImpError(f"{path}: cannot be written ({error.strerror}); choose another -o") from None


class TrajectoryWriter(Observer):
    """Writes trajectory.tum, odometry.tum, trajectory.csv; truth.tum where the log has a truth."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = Rows(folder / "trajectory.tum")
        self._odometry = Rows(folder / "odometry.tum")
        self._table = Rows(folder / "trajectory.csv", PATH_COLUMNS + "\n")
        self._truth: Rows | None = None

    def step(self, result: StepResult) -> None:
        """Append the pose of a scan."""
        (x, y, theta), P = result.pose, result.covariance
        self._path.add(tum_row(result.stamp, result.pose))
        self._odometry.add(tum_row(result.stamp, result.odometry))
        entries = (P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
        spread = ",".join(f"{value:.9e}" for value in entries)
        self._table.add(f"{result.stamp:.9f},{x:.9f},{y:.9f},{theta:.9f},{spread}\n")

    def truth(self, pose: TruePose) -> None:
        """Append a true pose."""
        if self._truth is None:
            self._truth = Rows(self._folder / TRUTH)
        self._truth.add(tum_row(pose.stamp, pose.pose))

    def finish(self, outcome: Outcome) -> None:
        """Write the last rows."""
        del outcome
        for rows in (self._path, self._odometry, self._table, self._truth):
            if rows is not None:
                rows.flush()
