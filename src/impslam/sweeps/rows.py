"""Rows of a table of runs: a run that fails is a row, too."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

from impslam.errors import ImpError, in_a_line

Row: TypeAlias = dict[str, Any]
"""A run: what was run, `error` (why it failed, or ""), then its metrics."""


def attempt(run: Row, measure: Callable[[], Row]) -> Row:
    """Return the row of a run: what it measures, or the error that has ended it."""
    try:
        return {**run, "error": "", **measure()}
    except Exception as error:  # hours of other runs are not lost for one
        return {**run, "error": in_a_line(error)}


def by_variant(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of the runs that did not fail, by the name of the variant.

    Raises
    ------
    ImpError
        If a variant has none.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["variant"], []).append(row)
    for name, runs in groups.items():
        if all(row["error"] for row in runs):
            raise ImpError(f"{name}: all {len(runs)} runs failed; the first: {runs[0]['error']}")
    return {name: [row for row in runs if not row["error"]] for name, runs in groups.items()}


def failures(rows: Iterable[Row]) -> str:
    """Return a sentence on the runs that failed; empty if none did."""
    lost = [row for row in rows if row["error"]]
    reasons = "; ".join(
        f"{r['world']}, {r['variant']}, seed {r['seed']}: {r['error']}" for r in lost
    )
    return f"Runs that failed and are left out: {reasons}." if lost else ""


def median_row(rows: Sequence[Row], metric: str = "end") -> Row:
    """Return the row whose metric is the (lower) median one."""
    return sorted(rows, key=lambda row: float(row[metric]))[(len(rows) - 1) // 2]
