"""The table of a sweep: one CSV and one Parquet file."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from impslam.extras import install
from impslam.paths import write_bytes
from impslam.sweeps.journal import CONTENTS, RUN
from impslam.sweeps.rows import Row

CSV, PARQUET = "runs.csv", "runs.parquet"
LAST = ("cpu_s", *CONTENTS)
log = logging.getLogger(__name__)
_ADVICE = "free disk space or check the folder"


def tidy(rows: Iterable[Row]) -> list[Row]:
    """Return rows of plain values: settings as columns, status and message, then the measures.

    They are sorted by log, config, settings and seed, independent of the order in which the runs finished.
    """
    return [_flat(row) for row in sorted(rows, key=_place)]


def _place(row: Row) -> tuple[Any, ...]:
    """Return the sort key of a row: numbers by size, before texts."""
    settings = [
        (key, isinstance(value, str), value if isinstance(value, str) else float(value))
        for key, value in row["settings"].items()
    ]
    return row["log"], row["config"] or "", settings, row["seed"]


def _flat(row: Row) -> Row:
    special = {*RUN, "error", *LAST}
    metrics = {key: value for key, value in row.items() if key not in special}
    return {
        "log": row["log"],
        "config": row["config"] or "(of the log)",
        **row["settings"],
        "seed": row["seed"],
        "status": "failed" if row["error"] else "ok",
        "message": row["error"],
        **metrics,
        **{name: row.get(name) for name in LAST},
    }


def columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return the columns of tidy rows, in the order of the longest row, with None for missing values."""
    names: dict[str, None] = {}
    for row in sorted(rows, key=len, reverse=True):
        names |= dict.fromkeys(row)
    return {name: [row.get(name) for row in rows] for name in names}


def write_table(folder: Path, rows: Iterable[Row]) -> list[Path]:
    """Write the table as CSV, and as Parquet if the extra `parquet` is installed; return the files.

    Raises
    ------
    ImpError
        If a file cannot be written; an earlier one then stays as it was.
    """
    table = columns(tidy(rows))
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(table)
    lines.writerows(zip(*table.values(), strict=True))
    write_bytes(folder / CSV, text.getvalue().encode(), _ADVICE)
    try:
        write_parquet(folder / PARQUET, table)
    except ImportError:
        log.warning("only %s is written; for Parquet: %s", folder / CSV, install("parquet"))
        return [folder / CSV]
    return [folder / CSV, folder / PARQUET]


def write_parquet(path: Path, table: dict[str, list[Any]]) -> None:
    """Write columns as a Parquet file, by way of memory: on a full disk arro3 ends with a panic.

    Raises
    ------
    ImpError
        If the file cannot be written.
    ImportError
        If the extra `parquet` is not installed.
    """
    from arro3.core import Array, Table  # noqa: PLC0415  # an extra
    from arro3.io import write_parquet as write  # noqa: PLC0415

    typed: dict[str, Any] = {}
    for name, values in table.items():
        kind = _type_of(values)
        texts = [None if value is None else str(value) for value in values]
        typed[name] = Array(texts if kind == "string" else values, type=_arrow(kind))
    data = io.BytesIO()
    write(Table.from_pydict(typed), data)
    write_bytes(path, data.getvalue(), _ADVICE)


def _arrow(kind: str) -> Any:
    from arro3.core import DataType  # noqa: PLC0415  # an extra

    return getattr(DataType, kind)()


def _type_of(values: Iterable[Any]) -> str:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return "bool"
    if kinds == {int}:
        return "int64"
    return "float64" if kinds <= {int, float} else "string"
