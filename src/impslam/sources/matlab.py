"""Common parts of the readers of MATLAB files: files are recognised by their variables."""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import PrivateAttr

from impslam.errors import SourceError
from impslam.sources.base import Source
from impslam.sources.unpack import UNIT_LIMIT, LimitError
from impslam.types import Array

_MAGIC = b"MATLAB 5.0 MAT-file"
_COMPRESSED = 15  # type of a variable compressed with zlib
Variables = Mapping[str, npt.NDArray[Any]]


def variables(path: Path) -> frozenset[str]:
    """Return the names of the variables in a MATLAB file; none for other, damaged or too large files."""
    if not _is_matlab(path) or _unpacked_size(path) > UNIT_LIMIT:
        return frozenset()
    from scipy.io import whosmat  # noqa: PLC0415  takes 0.1 s to import

    try:
        with warnings.catch_warnings(action="ignore"):
            found = whosmat(path)
            return frozenset(name for name, shape, _ in found if 8 * math.prod(shape) <= UNIT_LIMIT)
    except Exception:  # a damaged file may raise anything
        return frozenset()


def _unpacked_size(path: Path) -> int:
    """Return the size of a MATLAB file's unpacked variables, bytes; stop soon after the limit."""
    total = 0
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(126)
        order = ">" if file.read(2) == b"MI" else "<"
        while total <= UNIT_LIMIT and len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            end = min(file.tell() + length, size)
            total += _inflated_size(file, end) if kind == _COMPRESSED else end - file.tell()
            file.seek(end)
    return total


def _inflated_size(file: BinaryIO, end: int) -> int:
    """Return the unpacked size of a variable, bytes; stop at damaged data and soon after the limit."""
    total, inflate = 0, zlib.decompressobj()
    with suppress(zlib.error):
        while total <= UNIT_LIMIT and (packed := file.read(min(1 << 16, end - file.tell()))):
            while packed and total <= UNIT_LIMIT:
                total += len(inflate.decompress(packed, 1 << 20))
                packed = inflate.unconsumed_tail
    return total


def read_variables(path: Path, wanted: frozenset[str]) -> Variables:
    """Return variables of a MATLAB file.

    Raises
    ------
    SourceError
        If the file is damaged, or lacks one of them.
    """
    from scipy.io import loadmat  # noqa: PLC0415  takes 0.1 s to import

    try:
        with warnings.catch_warnings(action="ignore"):
            found = loadmat(path, variable_names=wanted)
    except Exception as error:  # a damaged file may raise anything
        reason = f"{error}".split("\n", 1)[0]
        raise SourceError(f"{path}: cannot be read ({reason}); copy it again") from None
    if missing := sorted(wanted - set(found)):
        raise SourceError(f"{path}: lacks {', '.join(missing)}; copy it again")
    return {name: found[name] for name in wanted}


def column(path: Path, values: Variables, name: str) -> Array:
    """Return a variable as float64 (n,); raise `SourceError` if it is not a row or column of numbers."""
    array = values[name]
    if array.dtype.kind not in "fiu" or array.size != max(array.shape, default=0):
        raise SourceError(f"{path}: {name} is not a row of numbers; copy it again")
    return array.ravel().astype(np.float64)


def same_length(path: Path, **columns: npt.NDArray[Any]) -> None:
    """Raise `SourceError` unless all columns have the same length."""
    if len({len(c) for c in columns.values()}) > 1:
        lengths = ", ".join(f"{name} {len(c)}" for name, c in columns.items())
        raise SourceError(f"{path}: lengths differ ({lengths}); copy it again")


def _is_matlab(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


class MatlabSource(Source):
    """A MATLAB file, or the folder that contains it; it is read as a whole, being a few MB."""

    needs: ClassVar[frozenset[str]]
    """Variables by which the log's file is recognised."""

    _count: int = PrivateAttr(0)
    _done: int = PrivateAttr(0)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by the variables in the file, or in a file of the folder.

        Raises
        ------
        LimitError
            If the path is a MATLAB file that is too large.
        """
        if _is_matlab(path) and _unpacked_size(path) > UNIT_LIMIT:
            raise LimitError(
                f"{path}: unpacks to more than {UNIT_LIMIT // 1_000_000} MB, twenty times the "
                "largest such log; check its origin"
            )
        return cls._find(path, cls.needs) is not None

    @classmethod
    def _find(cls, path: Path, wanted: frozenset[str]) -> Path | None:
        """Return the first file with all these variables: the path itself, or one in the folder."""
        files = sorted(path.glob("*.mat")) if path.is_dir() else [path]
        return next((file for file in files if wanted <= variables(file)), None)

    def _beside(self, wanted: frozenset[str]) -> Path | None:
        """Return the first file with all these variables in the folder of the log."""
        return self._find(self.path if self.path.is_dir() else self.path.parent, wanted)

    @property
    def _log(self) -> Path:
        log = self._find(self.path, self.needs)
        if log is None:
            raise SourceError(f"{self.path}: lacks {', '.join(sorted(self.needs))}; copy it again")
        return log

    @abstractmethod
    def _open(self, log: Path) -> int:
        """Read the log's file; return the number of messages."""

    def __enter__(self) -> Self:
        self._count = self._open(self._log)
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @abstractmethod
    def _close(self) -> None:
        """Release the data that were read."""

    @property
    def total(self) -> int | None:
        """Number of messages."""
        return self._count

    @property
    def position(self) -> int:
        """Number of messages read so far."""
        return self._done
