"""Rows of a table of runs; failed runs have rows, too."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

from impslam.errors import ImpError, in_a_line

Row: TypeAlias = dict[str, Any]
"""A run: its identity, `error` (why it failed, or ""), then its metrics."""


def attempt(run: Row, measure: Callable[[], Row]) -> Row:
    """Return the row of a run with its metrics, or with the error that ended it."""
    try:
        return {**run, "error": "", **measure()}
    except Exception as error:  # one failure must not end hours of other runs
        return {**run, "error": in_a_line(error)}


def by_variant(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of successful runs, by the name of the variant.

    Raises
    ------
    ImpError
        If all runs of a variant failed.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["variant"], []).append(row)
    for name, runs in groups.items():
        if all(row["error"] for row in runs):
            raise ImpError(f"{name}: all {len(runs)} runs failed; the first: {runs[0]['error']}")
    return {name: [row for row in runs if not row["error"]] for name, runs in groups.items()}


def failures(rows: Iterable[Row]) -> str:
    """Return a sentence on failed runs; empty if there are none."""
    lost = [row for row in rows if row["error"]]
    reasons = "; ".join(
        f"{r['world']}, {r['variant']}, seed {r['seed']}: {r['error']}" for r in lost
    )
    return f"Runs that failed and are left out: {reasons}." if lost else ""


def median_row(rows: Sequence[Row]) -> Row:
    """Return the row with the (lower) median of the error at the end."""
    return sorted(rows, key=lambda row: float(row["end"]))[(len(rows) - 1) // 2]
