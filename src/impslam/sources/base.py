"""The role of a source: stamped messages in the order in which they happened."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import ClassVar, NamedTuple, Self

from pydantic import PrivateAttr

from impslam.component import Component, components
from impslam.errors import SourceError
from impslam.types import Message, TrueLandmark

GAP = 10.0  # s; at walking pace a robot is then in another room, beyond what any gate bridges


@dataclass(frozen=True, slots=True)
class Stream:
    """One stream in a log, as `imp inspect` shows it. `count` is None where only reading tells."""

    topic: str
    type: str
    count: int | None
    used: bool
    note: str = ""


@dataclass(slots=True)
class Problems:
    """What was wrong with a log: a count and the first example of each kind of problem."""

    counts: dict[str, int] = field(default_factory=dict)
    examples: dict[str, str] = field(default_factory=dict)

    def add(self, kind: str, example: str) -> None:
        """Count one problem; `example` says what, where and what to do."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self.examples.setdefault(kind, example)


class Source(Component):
    """A context manager and an iterator of messages, lazy: memory does not grow with the log.

    Messages come in file order; where a log's stamps run backwards they are not sorted. A message
    that cannot be used is dropped and entered in `problems`.
    """

    role: ClassVar[str] = "source"
    default_preset: ClassVar[str] = "default"
    """The preset that fits logs of this format; a log that names its own overrides `preset`."""

    path: Path
    _problems: Problems = PrivateAttr(default_factory=Problems)

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Tell from the content, not the name, whether this is a log of this format."""

    @abstractmethod
    def __enter__(self) -> Self:
        """Open the log; raise `SourceError` if it cannot be read."""

    @abstractmethod
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the log."""

    @abstractmethod
    def __iter__(self) -> Iterator[Message]:  # type: ignore[override]
        """Yield messages in file order."""

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the surveyed landmarks that come with the log, in its own frame; for scoring."""
        return []

    @abstractmethod
    def streams(self) -> list[Stream]:
        """Return what is in the log; call it while the source is open."""

    @property
    def preset(self) -> str:
        """The preset (or the config, as TOML) that fits this log; ask while it is open."""
        return self.default_preset

    @property
    def problems(self) -> Problems:
        """What was dropped so far, and why."""
        return self._problems

    @property
    def total(self) -> int | None:
        """Number of steps for a progress bar (messages or bytes), or None if only reading tells.

        Ask while the source is open.
        """
        return None

    @property
    def position(self) -> int:
        """How far of `total` the iteration has come."""
        return 0


class Located(NamedTuple):
    """A message and where it stands in the log: its stream, and a line or message number.

    Messages of one record share its stamp; all but one leave `stream` empty, so that the stamp is
    checked once.
    """

    message: Message
    place: int
    stream: str = ""


def watched(messages: Iterable[Located], problems: Problems, log: Path) -> Iterator[Message]:
    """Pass messages on and count stamps that repeat, run backwards or leave a gap.

    Each stream is a clock of its own: a scan is stamped at its first beam and arrives after wheel
    angles that are younger. Nothing is dropped here; only the estimator knows what it can do with
    such a message.
    """
    latest: dict[str, float] = {}
    for message, place, stream in messages:
        if stream:
            before = latest.get(stream)
            latest[stream] = message.stamp
            if before is not None and not 0.0 < message.stamp - before <= GAP:
                _enter_stamp(problems, f"{log}:{place}: {stream}", before, message.stamp)
        yield message


def _enter_stamp(problems: Problems, where: str, before: float, stamp: float) -> None:
    if stamp > before:
        problems.add("gap", f"{where} has been silent for {stamp - before:.1f} s; was it paused?")
    elif stamp < before:
        problems.add(
            "backward stamp",
            f"{where} is stamped {before - stamp:.6f} s before its predecessor; file order is kept",
        )
    else:
        problems.add("repeated stamp", f"{where} has the stamp {stamp:.6f} of the one before it")


def recognise(path: Path) -> type[Source]:
    """Return the source class whose format the path's content has.

    Raises
    ------
    SourceError
        If the path is missing, empty, a pipe or a device, or of no known format.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder; check the path")
    if not (path.is_file() or path.is_dir()):
        raise SourceError(
            f"{path}: is neither a file nor a folder; copy what the pipe or device gives into a file"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise SourceError(f"{path}: the file is empty; record or copy it again")
    known = components("source")
    for cls in known.values():
        if issubclass(cls, Source) and cls.recognises(path):
            return cls
    raise SourceError(
        f"{path}: no known log format; readable are {', '.join(known)} (see `imp list`)"
    )
