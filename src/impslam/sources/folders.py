"""The files in a folder: the pieces of one bag, or the logs in a folder that is no log itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from itertools import islice
from pathlib import Path

MAX_SEARCHED, MAX_NAMED = 200, 5
"""Entries of a folder that are examined, and logs that are named."""
RUN_FILES = ("summary.json", "config.toml")
"""Files of the result of a run; its tables look like logs."""

_DATE = re.compile(r"\d{4}(-\d\d){5}")
"""The time at which a piece begins, in its name by `rosbag record --split`."""


def piece(path: Path) -> tuple[str, int] | None:
    """Return name and number of the piece NAME_N of a split log; None for any other name."""
    found = re.fullmatch(r"(.*)_(\d+)", _DATE.sub("", path.stem))
    return (found[1], int(found[2])) if found else None


def numbered_pieces(files: Collection[Path]) -> list[Path]:
    """Return the pieces NAME_0, NAME_1, ... of one log in order; none if some have other names."""
    found = {path: name for path in files if (name := piece(path))}
    numbers = {path: number for path, (_, number) in found.items()}
    names = {name for name, _ in found.values()}
    if len(numbers) < len(files) or len(names) > 1 or len(set(numbers.values())) < len(files):
        return []
    return sorted(numbers, key=lambda path: numbers[path])


def explain_folder(folder: Path, is_log: Callable[[Path], bool]) -> str:
    """Return what a folder contains and what to do with it; "" if it contains no log.

    Hidden files are ignored.
    """
    if all((folder / name).is_file() for name in RUN_FILES):
        return f"it contains the result of a run: give its log, or add others with --map {folder}/map.imp"
    entries = sorted(islice(folder.iterdir(), MAX_SEARCHED))
    logs = [path for path in entries if not path.name.startswith(".") and is_log(path)]
    if not logs:
        return ""
    named = ", ".join(path.name for path in logs[:MAX_NAMED])
    more = f" and {len(logs) - MAX_NAMED} more" if len(logs) > MAX_NAMED else ""
    if len(logs) == 1:
        return f"it contains the log {named}: give {logs[0]}"
    return (
        f"it contains {len(logs)} logs, {named}{more}: give one of them, such as {logs[0]}, and add others "
        "to its map with --map"
    )
