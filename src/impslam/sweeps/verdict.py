"""Results of a sweep: the errors of each log by variant, in the best available measure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from impslam.paths import short_names
from impslam.sweeps.rows import Row

MEASURES = {
    "ate_m": "path error (RMS)",
    "relation_m": "relation error (mean)",
    "disagreement_m": "disagreement of scans",
}
"""In order of preference: against the truth, against measured relations, without either."""


def variant_name(row: Row) -> str:
    """Return a short name of the config and the settings of a run."""
    values = [f"{'.'.join(key.split('.')[-2:])}={value}" for key, value in row["settings"].items()]
    return " ".join([row["config"], *values]).strip() or "preset of the log"


def log_names(logs: Iterable[str]) -> list[str]:
    """Return the names of logs' files, with folders if several files have the same name."""
    paths = [Path(log) for log in logs]
    names = [path.name for path in paths]
    return names if len(set(names)) == len(names) else short_names(paths)


def by_log(rows: Iterable[Row]) -> dict[str, dict[str, list[Row]]]:
    """Return the rows of successful runs, by log and then by variant."""
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        if not row["error"]:
            groups.setdefault(row["log"], {}).setdefault(variant_name(row), []).append(row)
    return groups


def measure_of(variants: Mapping[str, Sequence[Row]]) -> str:
    """Return the best measure available for a log's runs, "" if there is none."""
    known = [row for rows in variants.values() for row in rows]
    return next((m for m in MEASURES if any(row.get(m) is not None for row in known)), "")


def values_of(rows: Iterable[Row], measure: str) -> list[float]:
    """Return a measure of the runs that have it."""
    return [row[measure] for row in rows if row.get(measure) is not None]
