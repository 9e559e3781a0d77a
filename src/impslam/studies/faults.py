"""Fault injection, for `imp reproduce faults`: errors of the path, and whether the run reports them.

Each fault is injected into each drive with each seed; the run is compared with the clean one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impslam.studies.drives import RecordedDrive, recorded, simulated
from impslam.studies.fault_kinds import FAULTS
from impslam.studies.fault_scores import (
    MAX_SILENT,
    VERDICTS,
    limit_of,
    map_drive,
    score,
    with_truth,
)
from impslam.studies.report import Picture, ResultTable, Section, load_text, make_table
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row

SEEDS = 1
"""Default, for a quick look in a minute."""
CLEAN = next(iter(FAULTS))
WORLDS = ("arena", "corridor")
LOGS = {
    "intel": ("intel/intel.log", None),
    "fr079": ("fr079/fr079.log", None),
    "turtlebot3": ("turtlebot3/turtlebot3.bag", "turtlebot3-waffle"),
}
"""Paths of logs in the folder of `--data`, and their presets; missing logs are left out."""
TEXT = load_text("faults")
NOTES = TEXT["notes"]


class _Task(NamedTuple):
    """All faults of one drive: a world, or a log of that path with a preset."""

    name: str
    log: Path | None
    preset: str | None
    seed: int


def faults(job: Job) -> Section:
    """Inject every fault into every drive, and score the runs."""
    seeds = range(job.seeds or SEEDS)
    folder = job.data or Path()
    there = {n: (folder / path, preset) for n, (path, preset) in LOGS.items() if job.data}
    there = {name: given for name, given in there.items() if given[0].exists()}
    drives = {**dict.fromkeys(WORLDS, (None, None)), **there}
    tasks = [_Task(name, *given, seed) for name, given in drives.items() for seed in seeds]
    rows = [row for found in job.map(campaign, tasks, "map with every fault") for row in found]
    missing = ", ".join(sorted(set(LOGS) - set(there)))
    left_out = f"Left out, because --data has no such logs: {missing}." if missing else ""
    text = "\n\n".join(filter(None, (TEXT["text"], left_out)))
    tables = [fault_table(rows), drive_table(rows)]
    return Section("faults", TEXT["title"], text, tables, _pictures(rows), numbers(rows), rows)


def campaign(task: _Task) -> list[Row]:
    """Map one drive with every fault; return the rows, the clean run first."""
    drive = _drive(task)
    clean, exact = map_drive(drive), task.log is None
    if not exact:
        drive = with_truth(drive, clean)
    limit, rows = limit_of(clean, drive), []
    for k, (name, fault) in enumerate(FAULTS.items()):
        faulty = fault(drive, np.random.default_rng([task.seed, k]))
        found = score(faulty, limit, clean.notes, exact=exact)
        rows.append({"drive": task.name, "seed": task.seed, "fault": name, "limit": limit, **found})
    return rows


def _drive(task: _Task) -> RecordedDrive:
    if task.log is None:
        return simulated(task.name, task.seed)
    return recorded(task.log, task.preset)


def _count(verdict: str) -> Callable[[Sequence[Row]], str]:
    return lambda rows: str(sum(row["verdict"] == verdict for row in rows) or "")


def _share(rows: Sequence[Row], part: str, whole: str) -> float:
    total = sum(row.get(whole, 0) for row in rows)
    return sum(row.get(part, 0) for row in rows) / total if total else float("nan")


def _percent(part: str, whole: str) -> Callable[[Sequence[Row]], str]:
    return lambda rows: f"{100.0 * _share(rows, part, whole):.1f}"


def _off(rows: Sequence[Row]) -> str:
    found = [row["off"] for row in rows if "off" in row]
    return f"{np.median(found):.2f}" if found else ""


COLUMNS: dict[str, Callable[[Sequence[Row]], str]] = {
    "runs": lambda rows: str(len(rows)),
    **{verdict: _count(verdict) for verdict in VERDICTS},
    "unreported over 1 s": lambda rows: str(
        sum(row.get("silent_seconds", 0.0) > MAX_SILENT for row in rows) or ""
    ),
    "off at worst [m]": _off,
    "TRACKING [%]": _percent("tracking", "scans"),
    "of these inside 99 % [%]": _percent("inside", "tracking"),
}


def _by(rows: Sequence[Row], *keys: str) -> dict[Any, list[Row]]:
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        key = tuple(row[k] for k in keys)
        groups.setdefault(key if len(key) > 1 else key[0], []).append(row)
    return groups


def fault_table(rows: Sequence[Row]) -> ResultTable:
    """Return the results of each fault, over all drives."""
    groups = _by(rows, "fault")
    faulty = [row for row in rows if row["fault"] != CLEAN]
    return make_table("Faults", {**groups, "all faults": faulty}, COLUMNS, NOTES["faults"])


def drive_table(rows: Sequence[Row]) -> ResultTable:
    """Return the results of each drive: clean, and over all faults."""
    groups = {
        (name, kind): [row for row in some if (row["fault"] == CLEAN) == (kind == "clean")]
        for name, some in _by(rows, "drive").items()
        for kind in ("clean", "with faults")
    }
    more = {"CPU of a run [s]": lambda rows: f"{np.mean([row['seconds'] for row in rows]):.2f}"}
    labels = ("drive", "")
    return make_table("Drives", groups, {**COLUMNS, **more}, NOTES["drives"], labels)


def _pictures(rows: Sequence[Row]) -> list[Picture]:
    from impslam.evaluation.plots import as_png  # noqa: PLC0415  imports matplotlib
    from impslam.studies.faults_plot import draw_verdicts  # noqa: PLC0415

    return [Picture("faults", as_png(draw_verdicts(rows), dpi=160), TEXT["caption"])]


def numbers(rows: Sequence[Row]) -> Mapping[str, Any]:
    """Return the numbers behind the tables."""
    faulty = [row for row in rows if row["fault"] != CLEAN]
    counts = {v: sum(row["verdict"] == v for row in faulty) for v in VERDICTS}
    calibration = {
        name: _share(some, "inside", "tracking") for name, some in _by(faulty, "drive").items()
    }
    long = sum(row.get("silent_seconds", 0.0) > MAX_SILENT for row in faulty)
    shares = {"tracking_inside_99": calibration, "all": _share(faulty, "inside", "tracking")}
    return {"runs": len(faulty), "verdicts": counts, "unsaid_over_1_s": long, **shares}
