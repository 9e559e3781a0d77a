"""Score a faulty drive: errors of the path, its reported health, and the notes of the run."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from impslam.config_from_log import fitted
from impslam.diagnosis.diagnose import initial_findings
from impslam.diagnosis.finding import worst_fault
from impslam.errors import ImpError, in_a_line
from impslam.evaluation.consistency import nees, pose_errors
from impslam.geometry.chi_square import GATE_3D_99, GATE_3D_999
from impslam.health import TRACKING, Health
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.run import map_log
from impslam.studies.drives import DriveSource, RecordedDrive
from impslam.sweeps.rows import Row
from impslam.types import Array, Ints, Mask

MAX_SILENT = 1.0
"""s of silent scans within which a fault should be detected."""
MAX_LIMIT, LIMIT_FACTOR = 0.5, 5.0
"""m, and multiple of the worst error of the clean run: a pose with a larger error is wrong."""
REFERENCE_COVARIANCE = np.diag(np.array([0.02, 0.02, 0.005]) ** 2)
"""m, m, rad, squared: accuracy of the refined path of a clean run."""
MIN_LIMIT = 0.05
"""m: lower bound of a limit, the accuracy of a refined path."""
VERDICTS = ("harmless", "said", "honest", "noted", "silent")
"""harmless: no pose was wrong. said: no wrong pose was TRACKING, or the run rejected the log. honest: all
wrong TRACKING poses are within their ellipse. noted: some are not, but a note before or after the run names
a problem. silent: nothing does."""


class LiveRecorder(Observer):
    """Stores the poses as known at the time, and the outcome.

    Rows refer to `DriveSource`: `orders` are places in the log.
    """

    def __init__(self) -> None:
        self._paths: list[PathRows] = []
        self._orders: list[Ints] = []
        self.outcome: Outcome | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        """Store the poses of a track."""
        self._paths.append(path)
        self._orders.append(track.sweeps.columns.order[track.rows])

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Store the pose of a keyframe."""
        del revision
        self._paths.append(path)
        self._orders.append(keyframe.sweeps.columns.order[[keyframe.row]])

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Store the outcome."""
        del known
        self.outcome = outcome

    @property
    def orders(self) -> Ints:
        """Place in the log of each scan (n,)."""
        return np.concatenate(self._orders)

    @property
    def poses(self) -> Array:
        """Poses (n, 3) in map."""
        return np.concatenate([path.poses for path in self._paths])

    @property
    def covariances(self) -> Array:
        """Covariances (n, 3, 3)."""
        return np.concatenate([path.covariances for path in self._paths])


class MappedDrive(NamedTuple):
    """Result of mapping a drive.

    Attributes
    ----------
    rows : (k,) rows of the drive's scans that were used, in their order
    poses, covariances : (k, 3), (k, 3, 3) as known at the time
    refined : (k, 3) as known at the end
    health : of the k scans
    notes : kinds of problems that the run reported
    seconds : s of CPU
    """

    rows: Ints
    poses: Array
    covariances: Array
    refined: Array
    health: Health
    notes: frozenset[str]
    seconds: float


def map_drive(drive: RecordedDrive) -> MappedDrive:
    """Map a drive as `imp run` does.

    Raises
    ------
    ImpError
        If the run rejects it.
    """
    source, live = DriveSource.of(drive), LiveRecorder()
    begin = time.process_time()
    config = fitted(drive.config, source, odometry_is_free=True)
    findings = initial_findings(config, source)
    known = map_log(config, source, [live], fault=worst_fault(findings))
    seconds = time.process_time() - begin
    outcome = live.outcome
    assert outcome is not None
    rows = np.searchsorted(source.drive.scans.order, live.orders)
    notes = frozenset(outcome.dropped) | {finding.kind for finding in findings}
    refined = np.full((len(rows), 3), np.nan)
    refined[known.placed()] = known.path()[:, 1:]
    return MappedDrive(rows, live.poses, live.covariances, refined, outcome.health, notes, seconds)


def with_truth(drive: RecordedDrive, clean: MappedDrive) -> RecordedDrive:
    """Return a drive without truth, with the clean run's refined path as its truth."""
    truth = drive.truth.copy()
    truth[clean.rows] = clean.refined
    return drive._replace(truth=truth)


def errors(run: MappedDrive, drive: RecordedDrive, *, exact: bool) -> tuple[Array, Array]:
    """Return the position errors (k,) m of the poses, and their normalised errors squared (k,)."""
    error = pose_errors(run.poses, drive.truth[run.rows])
    covariances = run.covariances + (1e-12 * np.eye(3) if exact else REFERENCE_COVARIANCE)
    return np.hypot(error[:, 0], error[:, 1]), nees(error, covariances)


def score(drive: RecordedDrive, limit: float, usual: frozenset[str], *, exact: bool) -> Row:
    """Map a faulty drive and score it.

    `limit` is the error in m beyond which a pose is wrong, `usual` are the notes of the clean run, and
    `exact` is whether the truth is exact.
    """
    begin = time.process_time()
    try:
        run = map_drive(drive)
    except ImpError as error:
        seconds = time.process_time() - begin
        return {"verdict": "said", "said": in_a_line(error), "seconds": seconds}
    off, squares = errors(run, drive, exact=exact)
    tracking = run.health.states == TRACKING
    wrong, outside = off > limit, squares > GATE_3D_999
    silent = wrong & outside & tracking
    notes = run.notes - usual
    return {
        "verdict": _verdict(wrong, wrong & tracking, silent, notes),
        "off": float(off.max()),
        "off_at_end": float(off[-1]),
        "off_refined": _worst(run.refined - drive.truth[run.rows]),
        "scans": len(off),
        "tracking": int(tracking.sum()),
        "inside": int((tracking & (squares < GATE_3D_99)).sum()),
        "wrong": int(wrong.sum()),
        "silent": int(silent.sum()),
        "silent_seconds": float(silent.sum() * drive.period),
        "lost": int((run.health.states > 1).sum()),
        "said": run.health.summary,
        "notes": sorted(notes),
        "seconds": run.seconds,
    }


def _verdict(wrong: Mask, unreported: Mask, silent: Mask, notes: frozenset[str]) -> str:
    if silent.any():
        return "noted" if notes else "silent"
    if unreported.any():
        return "honest"
    return "said" if wrong.any() else "harmless"


def _worst(error: Array) -> float:
    placed = np.hypot(error[:, 0], error[:, 1])
    return float(np.nanmax(placed)) if np.isfinite(placed).any() else float("nan")


def limit_of(clean: MappedDrive, drive: RecordedDrive) -> float:
    """Return the error in m beyond which a pose is wrong, from the clean run of the drive."""
    worst = float(errors(clean, drive, exact=True)[0].max())
    return min(MAX_LIMIT, max(LIMIT_FACTOR * worst, MIN_LIMIT))
