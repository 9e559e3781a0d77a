"""The table of a sweep: a journal that grows run by run, and from it one CSV and one Parquet file."""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from impslam.errors import ConfigError
from impslam.evaluation.json_values import json_values
from impslam.extras import install
from impslam.sweeps.rows import Row

JOURNAL, CSV, PARQUET = "runs.jsonl", "runs.csv", "runs.parquet"
IDENTITY = ("log", "config", "settings", "seed", "log_sha256", "config_sha256")
"""What says which run a row is of."""
LAST = ("cpu_s", "log_sha256", "config_sha256")
log = logging.getLogger(__name__)


class Journal:
    """The rows of a sweep so far, a line of JSON each; of a run that was repeated, the newest row counts.

    It can be read whenever the program ends: a line that was cut is left out.

    Raises
    ------
    ConfigError
        If the folder holds something else, or cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._file = folder / JOURNAL
        if not self._file.exists() and folder.exists() and any(folder.iterdir()):
            raise ConfigError(
                f"{folder}: is not the folder of a sweep (it holds no {JOURNAL}); give -o a new one"
            )
        folder.mkdir(parents=True, exist_ok=True)
        whole = _whole_lines(self._file)
        self._rows = {identity(row): row for row in map(json.loads, whole)}
        self._file.write_text("".join(whole), encoding="utf-8")

    def add(self, row: Row) -> None:
        """Keep the row of a run."""
        self._rows[identity(row)] = known = json_values(row)
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(known, allow_nan=False) + "\n")

    def has(self, run: Row) -> bool:
        """Tell whether this run is done; one that failed is not."""
        row = self._rows.get(identity(run))
        return row is not None and not row["error"]

    def rows(self) -> list[Row]:
        """Return the newest row of each run."""
        return list(self._rows.values())


def _whole_lines(file: Path) -> list[str]:
    if not file.exists():
        return []
    lines = file.read_text("utf-8").splitlines(keepends=True)
    return [line for line in lines if line.endswith("}\n")]


def identity(row: Row) -> str:
    """Return text that is equal for rows of the same run."""
    return json.dumps([row[name] for name in IDENTITY], sort_keys=True)


def tidy(rows: Iterable[Row]) -> list[Row]:
    """Return rows of plain values: settings as columns, status and message, then the measures.

    They are sorted by log, config, settings and seed, whatever the order in which the runs ended.
    """
    return [_flat(row) for row in sorted(rows, key=identity)]


def _flat(row: Row) -> Row:
    told = {key: value for key, value in row.items() if key not in {*IDENTITY, "error", *LAST}}
    return {
        "log": row["log"],
        "config": row["config"] or "(of the log)",
        **row["settings"],
        "seed": row["seed"],
        "status": "failed" if row["error"] else "ok",
        "message": row["error"],
        **told,
        **{name: row.get(name) for name in LAST},
    }


def columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return the columns of tidy rows, in the order of the fullest row; None where a row has no value."""
    names: dict[str, None] = {}
    for row in sorted(rows, key=len, reverse=True):
        names |= dict.fromkeys(row)
    return {name: [row.get(name) for row in rows] for name in names}


def write_table(folder: Path, rows: Iterable[Row]) -> list[Path]:
    """Write the table as CSV, and as Parquet where the extra `parquet` is installed; return the files."""
    table = columns(tidy(rows))
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(table)
    lines.writerows(zip(*table.values(), strict=True))
    (folder / CSV).write_text(text.getvalue(), encoding="utf-8")
    try:
        write_parquet(folder / PARQUET, table)
    except ImportError:
        log.warning("only %s is written; for Parquet: %s", folder / CSV, install("parquet"))
        return [folder / CSV]
    return [folder / CSV, folder / PARQUET]


def write_parquet(path: Path, table: dict[str, list[Any]]) -> None:
    """Write columns as a Parquet file.

    Raises
    ------
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
    write(Table.from_pydict(typed), str(path))


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
