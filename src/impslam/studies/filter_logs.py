"""Filters on recorded logs of detected landmarks, for `imp reproduce filters --data FOLDER`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.fixes import plausible
from impslam.evaluation.label_votes import LabelVotes
from impslam.evaluation.run_files import RecordedRun
from impslam.evaluation.scores import normalised_errors
from impslam.evaluation.trajectory import associate, position_errors, start_frame
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.ending import EndOfRun
from impslam.open_log import open_log
from impslam.run import map_log
from impslam.studies.report import load_text
from impslam.sweeps.job import Job
from impslam.sweeps.memory import peak_memory
from impslam.sweeps.pool import ProcessDied, run_in_process
from impslam.sweeps.rows import Row, attempt
from impslam.types import Array

PARTS = 10
"""Stretches of each run that intervals are drawn from; errors of neighbours are correlated."""


class RecordedData(NamedTuple):
    """A log of one or several robots, and how it is mapped.

    Attributes
    ----------
    path : in the folder of `--data`
    settings : of all filters, before their own
    noise : of all filters, after their own: what their measurements are like, whatever the filter
    robots : numbers of the robots
    filters : that run only on this log, and their settings
    """

    path: str
    settings: Sequence[str] = ()
    noise: Sequence[str] = ()
    robots: Sequence[int] = (0,)
    filters: Mapping[str, Sequence[str]] = {}


LOGS = {name: RecordedData(**given) for name, given in load_text("filter_table")["logs"].items()}


class Drive(NamedTuple):
    """What is mapped: a robot's log, by a filter."""

    data: str
    filter: str
    log: Path
    settings: tuple[str, ...]
    robot: int


class LivePath(EndOfRun):
    """Keeps each pose, and its covariance, as it was known when it was new."""

    def __init__(self) -> None:
        super().__init__()
        self._live: list[PathRows] = []

    def follow(self, track: Track, path: PathRows) -> None:
        """Keep the poses of a track."""
        del track
        self._live.append(path)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Keep the pose of a keyframe."""
        del keyframe, revision
        self._live.append(path)

    def run(self) -> tuple[RecordedRun, Array]:
        """Return the run, and dead reckoning (n, 4)."""
        stamps, poses, covariances, odometry = map(np.concatenate, zip(*self._live, strict=True))
        path, wheels = (np.column_stack((stamps, column)) for column in (poses, odometry))
        return RecordedRun(path, covariances), wheels


def log_rows(filters: Mapping[str, Sequence[str]], job: Job) -> list[Row]:
    """Return a row for each filter on each robot of the logs in the folder of `job.data`."""
    drives = [
        Drive(data, name, job.data / log.path, (*log.settings, *given, *log.noise), robot)
        for data, log in LOGS.items()
        if job.data and (job.data / log.path).exists()
        for (name, given), robot in product({**filters, **log.filters}.items(), log.robots)
    ]
    return job.map(_row, drives, "logs")


def _row(drive: Drive) -> Row:
    given = {"world": drive.data, "variant": drive.filter, "seed": drive.robot}
    return attempt(given, partial(_measured_alone, drive))


def _measured_alone(drive: Drive) -> Row:
    """Measure in a process of its own: its memory is not that of what was mapped before."""
    row = run_in_process(measure, drive)
    if isinstance(row, ProcessDied):
        raise ImpError(row.why)
    return row


def measure(drive: Drive) -> Row:
    """Map a log; return errors of the poses as they were new, and what the filter did and took."""
    robot = [f"source.robot={drive.robot}"] if drive.robot else []
    config, source = open_log(drive.log, None, [*drive.settings, *robot])
    seen, labels = LivePath(), LabelVotes()
    map_log(config, source, [seen, labels])
    assert seen.outcome is not None
    run, odometry = seen.run()
    return {
        **errors(run, seen.path, odometry),
        "position2_at_checks": math.nan,
        "milliseconds": 1e3 * float(np.median(seen.outcome.stages["estimate"])),
        "wrong": labels.wrong,
        "matched": labels.matched,
        "megabytes": peak_memory() / 1e6,
    }


def errors(run: RecordedRun, truth: Array, odometry: Array) -> Row:
    """Return mean squares of a path's errors where it fits the truth (m, 4) best, and by tenths.

    NEES are of the path laid on the true start, NaN where that has no heading.
    """
    pairs = associate(run.path, truth[plausible(truth, odometry)])
    squares = position_errors(pairs.aligned()) ** 2
    start = start_frame(pairs, float(run.path[0, 0]))
    normalised = np.empty(0) if start is None else normalised_errors(run, pairs, start)[0]
    return {
        "nees": float(normalised.mean()) if len(normalised) else math.nan,
        "nees_parts": _parts(normalised),
        "position2": float(squares.mean()),
        "position2_parts": _parts(squares),
    }


def _parts(values: Array) -> list[float]:
    """Return the means of a run's stretches."""
    return [float(part.mean()) for part in np.array_split(values, PARTS) if len(part)]
