"""Files and folders: unused names, exchange, and errors of reading and writing."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import IO

from impslam.errors import ConfigError, ImpError

if sys.platform != "win32":
    import fcntl


def numbered(folder: Path, stem: str, suffix: str = "") -> Iterator[Path]:
    """Yield `folder/stem+suffix`, then with -2, -3, ... after the stem, without end."""
    yield folder / f"{stem}{suffix}"
    for number in count(2):
        yield folder / f"{stem}-{number}{suffix}"


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the paths without the leading and trailing parts that all have in common."""
    parts = [list(path.parts) for path in paths]
    while len(paths) > 1 and len({tuple(p[:1]) for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[1:] for p in parts]
    while len(paths) > 1 and len({tuple(p[-1:]) for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[:-1] for p in parts]
    if len(paths) == 1:
        parts = [p[-1:] or ["."] for p in parts]
    return [str(Path(*p)) for p in parts]


def make_folder(folder: Path, stem: str) -> Path:
    """Make a folder with the first free name; safe if several processes do so at once."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in numbered(folder, stem):
        with suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError("names never end")


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Make a folder if it does not exist, and reserve it for this process; nothing is left behind.

    The lock (flock) ends with the process, however that ends. Windows and some file systems have none.

    Raises
    ------
    ConfigError
        If another process has reserved it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if sys.platform == "win32":
        yield
        return
    lock = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = f"{folder}: another process writes to it; wait for its end, or give another -o"
            raise ConfigError(text) from None
        except OSError:
            pass
        yield
    finally:
        os.close(lock)


def exchange(a: Path, b: Path) -> None:
    """Exchange the names of two folders of one file system.

    This is atomic on Linux. Elsewhere there is a moment in which neither has the name `a`.
    """
    if not _exchanged(a, b):
        aside = next(path for path in numbered(a.parent, f".{a.name}-old") if not path.exists())
        a.rename(aside)
        b.rename(a)
        aside.rename(b)


def _exchanged(a: Path, b: Path) -> bool:
    """Call renameat2(2) with RENAME_EXCHANGE; return whether it succeeded."""
    if sys.platform != "linux":
        return False
    import ctypes  # noqa: PLC0415  # 5 ms that nothing else needs

    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    current, flag = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return call is not None and not call(current, os.fsencode(a), current, os.fsencode(b), flag)


@contextmanager
def written(path: Path, advice: str, kind: type[ImpError] = ImpError) -> Iterator[None]:
    """Turn an `OSError` while writing a file or a folder into an `ImpError` with advice."""
    try:
        yield
    except OSError as error:
        text = f"{path}: cannot be written ({error.strerror or error}); {advice}"
        raise kind(text) from None


def keep_inputs(inputs: Iterable[Path | None], outputs: Iterable[Path | None]) -> None:
    """Check, before a command writes anything, that its outputs leave its inputs unchanged.

    Raises
    ------
    ConfigError
        If an output is one of the inputs, also under another name, or is inside one that is a folder.
    """
    given = [path for path in inputs if path is not None and path.exists()]  # not names of presets
    for output in filter(None, outputs):
        for path in given:
            if _is_inside(output, path):
                how = "is inside the input" if path.is_dir() else "is the input"
                raise ConfigError(f"{output}: {how} {path} and would change it; give another path")


def _is_inside(path: Path, other: Path) -> bool:
    """Return whether a path is the other one, or inside it; links and hard links are followed."""
    if path.resolve().is_relative_to(other.resolve()):
        return True
    with suppress(OSError):
        return path.samefile(other)
    return False


@contextmanager
def replacement(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file that replaces a file if the block succeeds, and is removed if it fails.

    A device or pipe is written to, because it must not be replaced.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as stream:
            yield stream
        return
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes, advice: str = "give another path") -> None:
    """Write a file, completely or not at all.

    Raises
    ------
    ImpError
        If it cannot be written; its message ends with the advice.
    """
    with written(path, advice), replacement(path) as stream:
        stream.write(data)


@contextmanager
def replacements(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files replace those of a folder if the block succeeds.

    It is inside the folder, and is removed if the block fails: all files are replaced, or none.
    """
    with tempfile.TemporaryDirectory(prefix=".", suffix=".part", dir=folder) as part:
        yield Path(part)
        for path in Path(part).iterdir():
            path.replace(folder / path.name)
        sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, if the file system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def portable(path: Path, folder: Path) -> str:
    """Return a path for a file in a folder: relative to it, so that both can be copied to a computer.

    It is absolute if the two have no folder in common but the root.
    """
    target, start = path.resolve(), folder.resolve()
    if target.parts[:2] != start.parts[:2]:
        return str(target)
    return Path(os.path.relpath(target, start)).as_posix()


def is_file(path: Path) -> bool:
    """Return whether the file exists; False for an invalid name (too long, or with NUL)."""
    with suppress(OSError, ValueError):
        return path.is_file()
    return False


def is_folder(path: Path) -> bool:
    """Return whether the folder exists; False for an invalid name."""
    with suppress(OSError, ValueError):
        return path.is_dir()
    return False


def read_text(path: Path, advice: str, kind: type[ImpError] = ImpError) -> str:
    """Return the contents of a text file in UTF-8; raise an `ImpError` with advice if that fails."""
    try:
        return path.read_text("utf-8")
    except FileNotFoundError:
        raise kind(f"{path}: no such file; {advice}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file: it does not decode as UTF-8"
        raise kind(f"{path}: cannot be read as text ({reason}); {advice}") from None
