"""The file of a map: arrays and a JSON table in one uncompressed zip, like numpy's `.npz`.

Any program that reads `.npz` can read it. It is written to a temporary file, which then replaces the old
file, so that readers find either of them complete.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from impslam.errors import ConfigError, ImpError
from impslam.paths import is_file, is_folder, replacement, sync_folder, written

VERSION = 4
"""Version of the layout; see `layout`. Files of all versions up to this one can be read."""

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]
Layout: TypeAlias = Mapping[str, tuple[str, tuple[int | str, ...]]]
"""Type and shape of each array by name; named lengths are equal in all arrays."""
Built = TypeVar("Built")


def save(path: Path, arrays: Arrays, about: dict[str, Any]) -> Path:
    """Write a map's arrays and its table of JSON values; return the path.

    Raises
    ------
    ConfigError
        If the path is a file that is not a map.
    ImpError
        If the file cannot be written.
    """
    if path.is_file():
        check_replaceable(path)
    facts = {"version": VERSION, "about": about}
    table = json.dumps(facts, ensure_ascii=False, default=str)
    with written(path, "free disk space or check the folder"):
        with replacement(path) as stream:
            header = np.frombuffer(table.encode(), np.uint8)
            _write(stream, {"about": header, **arrays})
        sync_folder(path.parent)
    return path


def _write(stream: IO[bytes], arrays: Arrays) -> None:
    """Write like `np.savez`, but without copying each array first."""
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
    """Return the result of `build` for the arrays and the table of a map's file.

    The arrays are those of the layout of the file's version, read-only; `build` raises ValueError if they
    are inconsistent.

    Raises
    ------
    ImpError
        If the file is missing, damaged, not a map, or of a newer version.
    """
    if not is_file(path):
        if is_folder(path):
            raise ImpError(f"{path}: is a folder; give the file of a map, e.g. map.imp in it")
        raise ImpError(f"{path}: no such file; give a map that impslam has saved")
    try:
        file = path.open("rb")
    except OSError as error:
        raise ImpError(f"{path}: cannot be read ({error.strerror}); check permissions") from None
    try:
        with file, zipfile.ZipFile(file) as packed:
            version, about = _about(packed)
            return build(_arrays(packed, layout(version)), about)
    except _VersionError as error:
        raise ImpError(f"{path}: {error}") from None
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ImpError(
            f"{path}: not a map, or damaged ({reason}); give a map that impslam has saved"
        ) from None


def is_map(path: Path) -> bool:
    """Return whether a file is a map, of any version."""
    try:
        with zipfile.ZipFile(path) as packed:
            return "about.npy" in packed.namelist()
    except _DAMAGE:
        return False


def check_replaceable(path: Path) -> None:
    """Raise `ConfigError` if a path exists and is not a map."""
    if path.exists() and not is_map(path):
        raise ConfigError(f"{path}: exists and is not a map; give another path")


def about(path: Path) -> dict[str, Any]:
    """Return only the table of JSON values of a map's file.

    Raises
    ------
    ImpError
        If the file is missing, damaged, not a map, or of a newer version.
    """
    return load(path, lambda version: {}, lambda arrays, table: table)


class _VersionError(Exception):
    """The file is of a newer version."""


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
    ),  # for zips that are encrypted, or newer
)


def _about(packed: zipfile.ZipFile) -> tuple[int, dict[str, Any]]:
    """Return version and table."""
    table = json.loads(_array(packed, "about", np.dtype(np.uint8)).tobytes())
    version, about = int(table["version"]), dict(table["about"])
    if version > VERSION:
        raise _VersionError(
            f"is of version {version}, this program reads up to {VERSION}; update impslam"
        )
    if version < 1:
        raise ValueError(f"there is no version {version}")
    return version, about


def _arrays(packed: zipfile.ZipFile, layout: Layout) -> Arrays:
    """Return the arrays of a layout; named lengths must be equal."""
    arrays: Arrays = {}
    lengths: dict[str, int] = {}
    for name, (kind, shape) in layout.items():
        arrays[name] = array = _array(packed, name, np.dtype(kind))
        wanted = tuple(
            lengths.setdefault(side, length) if isinstance(side, str) else side
            for side, length in zip(shape, array.shape, strict=False)
        )
        if array.ndim != len(shape) or array.shape != wanted:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    return arrays


def _array(packed: zipfile.ZipFile, name: str, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return an array with the bytes in the file as memory, because its declared size may be wrong."""
    try:
        member = packed.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"it lacks {name}") from None
    if member.compress_type != zipfile.ZIP_STORED or member.compress_size != member.file_size:
        raise ValueError(f"{name} is compressed")
    data = packed.read(member)  # this tests the checksum
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} is of another format")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype != kind or by_columns:
        raise ValueError(f"{name} holds {dtype}, expected {kind} by rows")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name} has another length than declared")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape)
