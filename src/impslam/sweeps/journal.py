"""Journal of a sweep: the rows of finished runs, so that an interrupted sweep can be resumed."""

from __future__ import annotations

import json
from pathlib import Path

from impslam.errors import ConfigError
from impslam.evaluation.json_values import json_values
from impslam.paths import replacement
from impslam.sweeps.rows import Row

JOURNAL = "runs.jsonl"
RUN = ("log", "config", "settings", "seed")
"""Columns that identify a run."""
CONTENTS = ("log_sha256", "config_sha256", "references_sha256")
"""Columns of the hashes of its files: if one has changed, the run is repeated."""


class Journal:
    """The rows of a sweep so far, a line of JSON each; the newest row of a repeated run counts.

    The file is readable after a crash: an incomplete last line is ignored.

    Raises
    ------
    ConfigError
        If the folder contains something else, or cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._file = folder / JOURNAL
        if not self._file.exists() and folder.exists() and any(folder.iterdir()):
            raise ConfigError(
                f"{folder}: is not the folder of a sweep (no {JOURNAL} in it); give -o a new one"
            )
        folder.mkdir(parents=True, exist_ok=True)
        whole = _whole_lines(self._file)
        self._rows = {_key(row): row for row in map(json.loads, whole)}
        with replacement(self._file) as stream:  # a signal or a full disk leaves the old file
            stream.write("".join(whole).encode())

    def add(self, row: Row) -> None:
        """Store the row of a run."""
        self._rows[_key(row)] = known = json_values(row)
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(known, allow_nan=False) + "\n")

    def has(self, run: Row) -> bool:
        """Return whether this run has succeeded with the present files."""
        row = self._rows.get(_key(run))
        if row is None or row["error"]:
            return False
        return all(row.get(name, "") == run[name] for name in CONTENTS)

    def rows(self) -> list[Row]:
        """Return the newest row of each run."""
        return list(self._rows.values())


def _whole_lines(file: Path) -> list[str]:
    if not file.exists():
        return []
    lines = file.read_text("utf-8").splitlines(keepends=True)
    return [line for line in lines if line.endswith("}\n")]


def _key(row: Row) -> str:
    """Return a string that is equal for rows of the same run."""
    return json.dumps([row[name] for name in RUN], sort_keys=True)
