"""Writes many files so that a failure costs only the file that failed, and leaves no partial file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from impslam.errors import ImpError, in_a_line


class WriteAttempts:
    """Collects the errors of writing the files of a folder, and removes the failed files.

    Errors name the folder `destination` if the files are moved there later.
    """

    def __init__(self, folder: Path, destination: Path | None = None) -> None:
        self.folder, self._destination = folder, destination or folder
        self.failed: dict[str, Exception] = {}

    @contextmanager
    def __call__(self, *names: str, keep_partial: bool = False) -> Iterator[None]:
        """Write these files in the block; record an error instead of raising it.

        With `keep_partial`, files that could not be written completely are kept.
        """
        try:
            yield
        except Exception as error:  # a full disk or a bug in one writer must not cost other files
            for name in names:
                self.failed[name] = error
                if not keep_partial:
                    (self.folder / name).unlink(missing_ok=True)

    @property
    def message(self) -> str:
        """Which files could not be written and why; "" if all were written."""
        if not self.failed:
            return ""
        errors = list(self.failed.values())
        reasons = (error.strerror for error in errors if isinstance(error, OSError))
        reason = next(filter(None, reasons), "") or in_a_line(errors[0])
        return f"{', '.join(self.failed)} could not be written ({reason})"

    def check(self) -> None:
        """Raise an error if a file could not be written.

        Raises
        ------
        ImpError
            If it failed with an `OSError` or `ImpError`; other exceptions are raised unchanged.
        """
        for error in self.failed.values():
            if not isinstance(error, OSError | ImpError):
                raise error
        if self.failed:
            raise ImpError(
                f"{self._destination}: {self.message}; free disk space or check the folder"
            )
