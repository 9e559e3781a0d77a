"""Names of files and folders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path


def numbered(folder: Path, stem: str, suffix: str = "") -> Iterator[Path]:
    """Yield `folder/stem+suffix`, then with -2, -3, ... after the stem, without end."""
    yield folder / f"{stem}{suffix}"
    for number in count(2):
        yield folder / f"{stem}-{number}{suffix}"


def make_folder(folder: Path, stem: str) -> Path:
    """Make a folder of the first name that is free; who makes it has it, whoever else looks."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in numbered(folder, stem):
        with suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError("names never end")


def is_file(path: Path) -> bool:
    """Tell whether there is a file of this name, whatever the name: too long, or with NUL in it."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
