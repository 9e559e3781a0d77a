"""The file of a map: arrays and a JSON table in one uncompressed zip, as numpy's `.npz`.

Any program that reads `.npz` can read it. It is written beside its place and moved there, so that
a reader finds the old file or the new one, whole.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.errors import ImpError

VERSION = 1
"""Counts up when a file of an older version can no longer be read as it is."""

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]


def save(path: Path, arrays: Arrays, about: dict[str, Any]) -> Path:
    """Write a map's arrays and its table of plain values; return the path.

    Raises
    ------
    ImpError
        If the file cannot be written.
    """
    table = json.dumps({"version": VERSION, "about": about}, ensure_ascii=False, default=str)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with part.open("wb") as stream:
                header = np.frombuffer(table.encode(), np.uint8)
                np.savez(stream, **{"about": header, **arrays})  # type: ignore[arg-type]
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ImpError(
            f"{path}: cannot be written ({error.strerror or error}); choose another place"
        ) from None
    return path


def load(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays and the table of a map's file.

    Raises
    ------
    ImpError
        If the file is missing, is no map, is damaged, or comes from a newer version.
    """
    if not path.is_file():
        raise ImpError(f"{path}: no such file; give a map that impslam has saved")
    try:
        arrays = _read(path)
        table = json.loads(arrays.pop("about").tobytes())
        version, about = int(table["version"]), dict(table["about"])
    except (OSError, KeyError, ValueError, TypeError, MemoryError, zipfile.BadZipFile) as error:
        raise ImpError(f"{path}: not a map, or damaged ({error}); save it again") from None
    if version > VERSION:
        raise ImpError(
            f"{path}: is of version {version}, this program reads up to {VERSION}; update impslam"
        )
    return arrays, about


def _read(path: Path) -> Arrays:
    with zipfile.ZipFile(path) as packed:
        # What is stored uncompressed is no larger than the file: memory cannot be taken by a lie.
        if any(member.compress_type != zipfile.ZIP_STORED for member in packed.infolist()):
            raise ValueError("a part of it is compressed")
        if (bad := packed.testzip()) is not None:
            raise ValueError(f"the checksum of {bad} is wrong")
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
