"""The file of a map: arrays and a JSON table in one uncompressed zip, as numpy's `.npz`.

Any program that reads `.npz` can read it. It is written beside its place and moved there, so that
a reader finds the old file or the new one, whole.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from impslam.errors import ImpError
from impslam.paths import written

VERSION = 3
"""Counts up with what a file holds; see `layout`. Files of all versions up to this one can be read."""
FREE = "belief/"
"""Arrays whose names begin so are those of an estimator: any names, shapes and numbers."""

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]
Layout: TypeAlias = Mapping[str, tuple[str, tuple[int | str, ...]]]
"""Type and shape of each array by its name; a length that has a name is the same wherever it stands."""
Built = TypeVar("Built")


def save(path: Path, arrays: Arrays, about: dict[str, Any]) -> Path:
    """Write a map's arrays and its table of plain values; return the path.

    Raises
    ------
    ImpError
        If the file cannot be written.
    """
    free = [name for name in arrays if name.startswith(FREE)]
    facts = {"version": VERSION, "about": about, "free": free}
    table = json.dumps(facts, ensure_ascii=False, default=str)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    with written(path, "choose another place"):
        try:
            with part.open("wb") as stream:
                header = np.frombuffer(table.encode(), np.uint8)
                _write(stream, {"about": header, **arrays})
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
            _settle(path.parent)
        finally:
            part.unlink(missing_ok=True)
    return path


def _settle(folder: Path) -> None:
    """Have the names in a folder written to the disk; not every file system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _write(stream: IO[bytes], arrays: Arrays) -> None:
    """Write what `np.savez` would, but an array from its own memory: `savez` copies each first."""
    with zipfile.ZipFile(stream, "w") as packed:
        for name, array in arrays.items():
            rows = np.ascontiguousarray(array)
            with packed.open(f"{name}.npy", "w", force_zip64=True) as member:
                facts = np.lib.format.header_data_from_array_1_0(rows)
                np.lib.format.write_array_header_1_0(member, facts)
                member.write(rows.reshape(-1).view(np.uint8).data)


def load(
    path: Path, layout: Callable[[int], Layout], build: Callable[[Arrays, dict[str, Any]], Built]
) -> Built:
    """Return what `build` makes of the arrays and the table of a map's file.

    The arrays are those of the layout of the file's version, read-only; `build` raises ValueError
    where they do not fit each other.

    Raises
    ------
    ImpError
        If the file is missing, is no map, is damaged, or comes from a newer version.
    """
    if not path.is_file():
        raise ImpError(f"{path}: no such file; give a map that impslam has saved")
    try:
        with zipfile.ZipFile(path) as packed:
            version, about, free = _about(packed)
            arrays = _arrays(packed, layout(version))
            return build(arrays | {name: _array(packed, name) for name in free}, about)
    except _Version as error:
        raise ImpError(f"{path}: {error}") from None
    except _DAMAGE as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ImpError(f"{path}: not a map, or damaged ({said}); save it again") from None


def about(path: Path) -> dict[str, Any]:
    """Return the table of plain values of a map's file alone.

    Raises
    ------
    ImpError
        If the file is missing, is no map, is damaged, or comes from a newer version.
    """
    return load(path, lambda version: {}, lambda arrays, table: table)


class _Version(Exception):
    """The file is of another version."""


_DAMAGE = (
    *(
        OSError,
        EOFError,
        KeyError,
        ValueError,
        TypeError,
        MemoryError,
        RecursionError,
        struct.error,
    ),
    *(
        NotImplementedError,
        RuntimeError,
        zipfile.BadZipFile,
    ),  # of zips that are encrypted, or newer
)


def _about(packed: zipfile.ZipFile) -> tuple[int, dict[str, Any], list[str]]:
    """Return version, table and names of free arrays."""
    table = json.loads(_array(packed, "about", np.dtype(np.uint8)).tobytes())
    version, about = int(table["version"]), dict(table["about"])
    if version > VERSION:
        raise _Version(
            f"is of version {version}, this program reads up to {VERSION}; update impslam"
        )
    if version < 1:
        raise ValueError(f"there is no version {version}")
    free = [str(name) for name in table.get("free", [])]
    if not all(name.startswith(FREE) for name in free):
        raise ValueError(f"{free} are no names of free arrays")
    return version, about, free


def _arrays(packed: zipfile.ZipFile, layout: Layout) -> Arrays:
    """Return the arrays of a layout; lengths that it calls by one name are the same."""
    arrays: Arrays = {}
    lengths: dict[str, int] = {}
    for name, (kind, shape) in layout.items():
        arrays[name] = array = _array(packed, name, np.dtype(kind))
        wanted = tuple(
            lengths.setdefault(side, have) if isinstance(side, str) else side
            for side, have in zip(shape, array.shape, strict=False)
        )
        if array.ndim != len(shape) or array.shape != wanted:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    return arrays


def _array(
    packed: zipfile.ZipFile, name: str, wanted: np.dtype[Any] | None = None
) -> npt.NDArray[Any]:
    """Return an array, whose memory is that of its bytes in the file: what it says of its size may lie."""
    try:
        member = packed.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"it lacks {name}") from None
    if member.compress_type != zipfile.ZIP_STORED or member.compress_size != member.file_size:
        raise ValueError(f"{name} is compressed")
    data = packed.read(member)  # the checksum is tested on the way
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} is of another format")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    kind = wanted or dtype
    if dtype != kind or dtype.kind not in "fiub" or by_columns:
        raise ValueError(f"{name} holds {dtype}, expected {kind} by rows")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name} is not as long as it says")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape)
