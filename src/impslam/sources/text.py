"""Common parts of the readers of text logs: numbered lines, plain or gzipped."""

from __future__ import annotations

import gzip
import math
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from io import BufferedIOBase, BytesIO
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import PrivateAttr

from impslam.errors import MessageError, SourceError
from impslam.sources.base import Source
from impslam.types import Array

LINE_LIMIT = 1 << 20  # bytes, ten times the longest line of any lidar here; bounds memory
BLOCK = 1 << 18  # bytes read at once: a hundred scans
BEAMS_LIMIT = 100_000  # beams of a scan, ten times those of any 2D lidar
TURNS_LIMIT = 2.0  # turns of a scan; angles in degrees make 57 of each
WORDS_LIMIT = 100  # first words that are counted separately; formats have some ten
_HEAD = 1 << 16  # bytes read to recognise a format
DAMAGE = (OSError, EOFError, zlib.error)


def _first_line(text: bytes) -> int:
    """Return the length of the first line."""
    end = text.find(b"\n")
    return len(text) if end < 0 else end


@contextmanager
def open_text(path: Path) -> Iterator[tuple[BufferedIOBase, BufferedIOBase]]:
    """Open a plain or gzipped file; yield the file on disk and the text in it, both binary."""
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        if not packed:
            yield raw, raw
            return
        with gzip.GzipFile(fileobj=raw) as text:
            yield raw, text


def head(path: Path) -> list[bytes]:
    """Return the first complete lines of a text file; none if it is a folder or binary."""
    if not path.is_file():
        return []
    start = b""
    try:
        with open_text(path) as (_, text):
            while len(start) < _HEAD and (more := text.read1(_HEAD)):
                start += more
    except DAMAGE:
        pass  # the text before the damage may suffice
    if b"\0" in start:
        return []
    lines = start.splitlines(keepends=True)
    return [line for line in lines if line.endswith((b"\n", b"\r"))] or lines


def numbers(tokens: list[bytes]) -> Array:
    """Return tokens as float64; raise `ValueError` with the first that is not a number."""
    return np.fromiter(map(float, tokens), np.float64, len(tokens))


def check_finite(what: str, *values: float) -> None:
    """Raise `MessageError` unless the sum, hence every value, is finite."""
    if not math.isfinite(sum(values)):
        raise MessageError(f"{what} is not finite")


@lru_cache(maxsize=64)
def beam_angles(n: int, start: float, step: float) -> Array:
    """Return n equally spaced angles from `start`, read-only and shared between scans.

    Raises
    ------
    MessageError
        If there are more than `BEAMS_LIMIT`, or their angles are impossible.
    """
    if n > BEAMS_LIMIT:
        raise MessageError(f"a scan of {n} beams; no lidar has more than {BEAMS_LIMIT}")
    if n > 1 and step == 0.0:
        raise MessageError(f"the angle between its {n} beams is 0; write it in rad")
    if (turns := n * abs(step) / math.tau) > TURNS_LIMIT:
        raise MessageError(
            f"{n} beams {step:g} rad apart are {turns:.0f} turns; write the angles of beams in rad, not "
            "in degrees"
        )
    return _shared(start + step * np.arange(n, dtype=np.float64))


@lru_cache(maxsize=64)
def beam_times(n: int, step: float = 0.0) -> Array:
    """Return the time offsets of n beams fired every `step` seconds, read-only and shared."""
    return _shared(step * np.arange(n, dtype=np.float64))


def _shared(values: Array) -> Array:
    values.flags.writeable = False
    return values


class TextSource(Source):
    """A text log with one or more messages per line, which subclasses interpret."""

    _open: dict[Path, BufferedIOBase] = PrivateAttr(default_factory=dict)

    def _files(self) -> list[Path]:
        """Return the files that make up the log."""
        return [self.path]

    def __enter__(self) -> Self:
        for path in self._files():
            try:
                with open_text(path) as (_, text):
                    text.readline(LINE_LIMIT)
            except DAMAGE as error:
                raise SourceError(f"{path}: cannot be read ({error}); copy it again") from None
        return self

    def __exit__(self, *_: object) -> None:
        self._open.clear()

    def _blocks(self, path: Path) -> Iterator[tuple[int, bytes]]:
        """Yield (number of the first line, complete lines); numbers start at 1.

        A damaged gzip file ends early, and a problem is reported.
        """
        number, text = 1, b""
        try:
            with open_text(path) as (raw, file):
                self._open[path] = raw
                while more := file.read1(BLOCK):
                    text += more
                    if _first_line(text) >= LINE_LIMIT:
                        yield number, text[:LINE_LIMIT]
                        number, text = number + 1, text[LINE_LIMIT:]
                    if len(text) >= BLOCK:
                        end = text.rfind(b"\n") + 1
                        block, text = text[:end], text[end:]
                        yield number, block
                        number += block.count(b"\n")
            if text:
                yield number, text
        except DAMAGE as error:
            if whole := text[: text.rfind(b"\n") + 1]:
                yield number, whole
            self._problems.add(
                "damaged file",
                f"{path}: ends early ({error}); the part before is used; copy it again",
            )

    def _lines(self, path: Path) -> Iterator[tuple[int, bytes]]:
        """Yield (number, line); numbers start at 1."""
        for number, block in self._blocks(path):
            yield from enumerate(BytesIO(block), number)

    def _reject(self, kind: str, path: Path, number: int, why: object) -> None:
        self._problems.add(f"malformed {kind}", f"{path}:{number}: {why}; the line is dropped")

    def _first_words(self, path: Path) -> Counter[str]:
        """Count the lines of a file by their first word, in a separate pass."""
        counts: Counter[str] = Counter()
        try:
            with open_text(path) as (_, text):
                for line in iter(partial(text.readline, LINE_LIMIT), b""):
                    first = line[:32].split(None, 1)[:1]
                    word = first[0].decode("ascii", "replace") if first else ""
                    counts[word if word in counts or len(counts) < WORDS_LIMIT else "..."] += 1
        except DAMAGE:
            pass  # iteration reports it in `problems`
        return counts

    @property
    def total(self) -> int | None:
        """Size of the files on disk in bytes."""
        return sum(path.stat().st_size for path in self._files())

    @property
    def position(self) -> int:
        """Number of bytes read so far from the files on disk."""
        return sum(
            path.stat().st_size if raw.closed else raw.tell() for path, raw in self._open.items()
        )
