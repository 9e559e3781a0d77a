"""What the readers of MATLAB files share: a file or a folder of them, opened by the variables inside."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import PrivateAttr

from impslam.errors import SourceError
from impslam.sources.base import Located, Source, watched
from impslam.types import Array, Message

_MAGIC = b"MATLAB 5.0 MAT-file"
Variables = Mapping[str, npt.NDArray[Any]]


def variables(path: Path) -> frozenset[str]:
    """Return the names of the variables in a MATLAB file; none if it is none, or damaged."""
    if not _is_matlab(path):
        return frozenset()
    from scipy.io import whosmat  # noqa: PLC0415  0.1 s, only for this

    try:
        with warnings.catch_warnings(action="ignore"):
            return frozenset(name for name, _, _ in whosmat(path))
    except Exception:  # what a damaged file raises is anyone's guess
        return frozenset()


def read_variables(path: Path, wanted: frozenset[str]) -> Variables:
    """Return variables of a MATLAB file.

    Raises
    ------
    SourceError
        If the file is damaged, or lacks one of them.
    """
    from scipy.io import loadmat  # noqa: PLC0415  0.1 s, only for this

    try:
        with warnings.catch_warnings(action="ignore"):
            found = loadmat(path, variable_names=wanted)
    except Exception as error:  # what a damaged file raises is anyone's guess
        said = f"{error}".split("\n", 1)[0]
        raise SourceError(f"{path}: cannot be read ({said}); copy it again") from None
    if missing := sorted(wanted - set(found)):
        raise SourceError(f"{path}: lacks {', '.join(missing)}; copy it again")
    return {name: found[name] for name in wanted}


def column(path: Path, values: Variables, name: str) -> Array:
    """Return a variable as float64 (n,); `SourceError` where it is no row or column of numbers."""
    array = values[name]
    if array.dtype.kind not in "fiu" or array.size != max(array.shape, default=0):
        raise SourceError(f"{path}: {name} is no row of numbers; copy it again")
    return array.ravel().astype(np.float64)


def same_length(path: Path, **columns: npt.NDArray[Any]) -> None:
    """Raise `SourceError` unless all columns are of one length."""
    if len({len(c) for c in columns.values()}) > 1:
        said = ", ".join(f"{name} {len(c)}" for name, c in columns.items())
        raise SourceError(f"{path}: lengths differ ({said}); copy it again")


def _is_matlab(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


class MatlabSource(Source):
    """A MATLAB file, or the folder it is in; such files are read whole, being a few MB."""

    needs: ClassVar[frozenset[str]]
    """Variables by which the file of the log is known."""

    _count: int = PrivateAttr(0)
    _done: int = PrivateAttr(0)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Tell by the variables in the file, or in a file of the folder."""
        return cls._find(path, cls.needs) is not None

    @classmethod
    def _find(cls, path: Path, wanted: frozenset[str]) -> Path | None:
        """Return the first file with some variables: the path itself, or one in the folder."""
        files = sorted(path.glob("*.mat")) if path.is_dir() else [path]
        return next((file for file in files if wanted <= variables(file)), None)

    def _beside(self, wanted: frozenset[str]) -> Path | None:
        """Return the first file with some variables in the folder of the log."""
        return self._find(self.path if self.path.is_dir() else self.path.parent, wanted)

    @property
    def _log(self) -> Path:
        log = self._find(self.path, self.needs)
        if log is None:
            raise SourceError(f"{self.path}: lacks {', '.join(sorted(self.needs))}; copy it again")
        return log

    @abstractmethod
    def _open(self, log: Path) -> int:
        """Read the log's file; return how many messages there are."""

    @abstractmethod
    def _messages(self) -> Iterator[Located]:
        """Yield the messages in order."""

    def __enter__(self) -> Self:
        self._count = self._open(self._log)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    @abstractmethod
    def _close(self) -> None:
        """Let go of what was read."""

    def __iter__(self) -> Iterator[Message]:  # type: ignore[override]  # not a model's fields
        return watched(self._messages(), self._problems, self.path)

    @property
    def total(self) -> int | None:
        """Number of messages."""
        return self._count

    @property
    def position(self) -> int:
        """Messages read so far."""
        return self._done
