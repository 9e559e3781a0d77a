"""Names of files and folders."""

from __future__ import annotations

from pathlib import Path


def unused(folder: Path, stem: str, suffix: str = "") -> Path:
    """Return `folder/stem+suffix`, with -2, -3, ... after the stem if that name is taken."""
    path, number = folder / f"{stem}{suffix}", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


def is_file(path: Path) -> bool:
    """Tell whether there is a file of this name, whatever the name: too long, or with NUL in it."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
