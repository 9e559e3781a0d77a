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
"""Stretches of each run that are resampled for intervals; errors of neighbours are correlated."""


class RecordedData(NamedTuple):
    """A log of one or several robots, with settings for mapping.

    Attributes
    ----------
    path : in the folder of `--data`
    settings : of all filters, overridden by their own
    noise : measurement noise of all filters, overriding their own settings
    robots : numbers of the robots
    filters : filters that run only on this log, with their settings
    """

    path: str
    settings: Sequence[str] = ()
    noise: Sequence[str] = ()
    robots: Sequence[int] = (0,)
    filters: Mapping[str, Sequence[str]] = {}


LOGS = {name: RecordedData(**given) for name, given in load_text("filter_table")["logs"].items()}


class FilterTask(NamedTuple):
    """A robot's log to map with a filter."""

    data: str
    filter: str
    log: Path
    settings: tuple[str, ...]
    robot: int


class LivePath(EndOfRun):
    """Stores each pose with its covariance as known at its time."""

    def __init__(self) -> None:
        super().__init__()
        self._live: list[PathRows] = []

    def follow(self, track: Track, path: PathRows) -> None:
        """Store the poses of a track."""
        del track
        self._live.append(path)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Store the pose of a keyframe."""
        del keyframe, revision
        self._live.append(path)

    def run(self) -> tuple[RecordedRun, Array]:
        """Return the run, and dead reckoning (n, 4)."""
        stamps, poses, covariances, odometry = map(np.concatenate, zip(*self._live, strict=True))
        path, reckoned = (np.column_stack((stamps, column)) for column in (poses, odometry))
        return RecordedRun(path, covariances), reckoned


def log_rows(filters: Mapping[str, Sequence[str]], job: Job) -> list[Row]:
    """Return a row for each filter on each robot of the logs in the folder of `job.data`."""
    drives = [
        FilterTask(data, name, job.data / log.path, (*log.settings, *given, *log.noise), robot)
        for data, log in LOGS.items()
        if job.data and (job.data / log.path).exists()
        for (name, given), robot in product({**filters, **log.filters}.items(), log.robots)
    ]
    return job.map(_row, drives, "logs")


def _row(drive: FilterTask) -> Row:
    given = {"world": drive.data, "variant": drive.filter, "seed": drive.robot}
    return attempt(given, partial(_measure_in_process, drive))


def _measure_in_process(drive: FilterTask) -> Row:
    """Measure in a new process, so that its memory does not include previous runs."""
    row = run_in_process(measure, drive)
    if isinstance(row, ProcessDied):
        raise ImpError(row.why)
    return row


def measure(drive: FilterTask) -> Row:
    """Map a log; return the errors of the live poses, wrong matches, time and memory."""
    robot = [f"source.robot={drive.robot}"] if drive.robot else []
    config, source = open_log(drive.log, None, [*drive.settings, *robot])
    live, labels = LivePath(), LabelVotes()
    map_log(config, source, [live, labels])
    assert live.outcome is not None
    run, odometry = live.run()
    return {
        **errors(run, live.path, odometry),
        "position2_at_checks": math.nan,
        "milliseconds": 1e3 * float(np.median(live.outcome.stages["estimate"])),
        "wrong": labels.wrong,
        "matched": labels.matched,
        "megabytes": peak_memory() / 1e6,
    }


def errors(run: RecordedRun, truth: Array, odometry: Array) -> Row:
    """Return mean squares of a path's errors after a fit to the truth (m, 4), in total and by tenths.

    NEES are of the path aligned at the true start; NaN if the start has no heading.
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
