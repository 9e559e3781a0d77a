"""Writing many files of which one may fail: the others are written, and none is left half."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from impslam.errors import ImpError, in_a_line


class FileByFile:
    """Remembers which files of a folder could not be written, and removes what there is of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.failed: dict[str, Exception] = {}

    @contextmanager
    def __call__(self, *names: str, grows: bool = False) -> Iterator[None]:
        """Write these files in the block; an error ends the block only.

        A file that `grows` row by row is worth having as far as it goes.
        """
        try:
            yield
        except Exception as error:  # a full disk or a fault of one writer costs no other file
            for name in names:
                self.failed[name] = error
                if not grows:
                    (self.folder / name).unlink(missing_ok=True)

    @property
    def said(self) -> str:
        """Which files could not be written and why, "" if all were."""
        if not self.failed:
            return ""
        errors = list(self.failed.values())
        said = (error.strerror for error in errors if isinstance(error, OSError))
        reason = next(filter(None, said), "") or in_a_line(errors[0])
        return f"{', '.join(self.failed)} could not be written ({reason})"

    def check(self) -> None:
        """Raise an error for what could not be written.

        Raises
        ------
        ImpError
            If a file could not be written; another exception is raised as it was.
        """
        for error in self.failed.values():
            if not isinstance(error, OSError | ImpError):
                raise error
        if self.failed:
            raise ImpError(f"{self.folder}: {self.said}; make room there or choose another")
