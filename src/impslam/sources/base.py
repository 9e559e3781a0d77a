"""The role of a source: it reads the streams of a log as columns, in recording order."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

from pydantic import PrivateAttr

from impslam.columns import ROWS, Batch
from impslam.component import Component, find, names, near_miss, parameter
from impslam.errors import ImpError, SourceError
from impslam.sources.folders import explain_folder
from impslam.sources.parts import LocatedMessage, Piece, gather, to_batches
from impslam.sources.stamps import StampCheck
from impslam.types import Message, TrueLandmark


@dataclass(frozen=True, slots=True)
class Stream:
    """A stream of a log, as shown by `imp inspect`.

    Attributes
    ----------
    name : the name of its columns, if it is read
    type : the type of its messages, as named in the log
    count : number of rows; None if it is known only after reading
    used : whether it is read, because mapping can use it
    note : what it contains, and how to use it if it is not used
    default : whether it is the default of its kind
    """

    name: str
    type: str
    count: int | None
    used: bool
    note: str = ""
    default: bool = False


@dataclass(frozen=True, slots=True)
class Mount:
    """The mount of a laser or an antenna, according to a log.

    Attributes
    ----------
    pose : (x, y, yaw) `T_base_laser` in the plane, m, m, rad; None if unknown
    upside_down : whether its z axis points down
    tilt : angle between its plane and that of base, rad
    origin : the part of the log that contains it, or why it is unknown
    base : name of the base frame in the log
    rivals : other mounts by contradictory parts of the log, which are their `origin`
    """

    pose: tuple[float, float, float] | None
    upside_down: bool = False
    tilt: float = 0.0
    origin: str = ""
    base: str = ""
    rivals: tuple[Mount, ...] = ()


@dataclass(slots=True)
class Problems:
    """Problems of a log or run: the count and first example of each kind."""

    counts: dict[str, int] = field(default_factory=dict)
    examples: dict[str, str] = field(default_factory=dict)

    def add(self, kind: str, example: str, count: int = 1) -> None:
        """Count problems of a kind; `example` describes the first one: what, where, what to do."""
        self.counts[kind] = self.counts.get(kind, 0) + count
        self.examples.setdefault(kind, example)


class Source(Component):
    """A context manager that reads the streams of a log as columns, lazily and in bounded memory.

    Rows come in file order, even if stamps go backwards. A row that cannot be used is dropped and added to
    `problems`. One stream of each kind is read; others, such as a second lidar, only if named in `wanted`.

    A subclass yields its rows either as messages (`_messages`) or, if that is faster, as columns
    (`_parts`).
    """

    role: ClassVar[str] = "source"
    describes_robot: ClassVar[bool] = False
    """Whether `kinds` and `mounts` return data; the log must be opened for them."""
    default_preset: ClassVar[str] = "default"
    """The preset that fits logs of this format; `preset` differs if a log names its own."""

    path: Path
    wanted: tuple[str, ...] = parameter(
        (), "1", "names of further streams to read, e.g. of a second lidar; see imp inspect"
    )
    _problems: Problems = PrivateAttr(default_factory=Problems)

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether the path is a log of this format, judging by its content, not its name."""

    @classmethod
    def explain_refusal(cls, path: Path) -> str:
        """Say why a path that is nearly a log of this format is none, and what to do; "" if it is not."""
        del path
        return ""

    @abstractmethod
    def __enter__(self) -> Self:
        """Open the log; raise `SourceError` if it cannot be read."""

    @abstractmethod
    def __exit__(self, *_: object) -> None:
        """Close the log."""

    def batches(self, rows: int = ROWS) -> Iterator[Batch]:
        """Yield the log as columns by stream name, at most `rows` rows at a time.

        The rows and their order do not depend on `rows`. Rows from one record share its stamp.

        Raises
        ------
        SourceError
            If the log cannot be read, or lacks a stream named in `wanted`.
        """
        self._check_wanted()
        stamps = StampCheck(self.path)
        for part in self._parts(rows):
            for kind, example, count in stamps.check(part):
                self._problems.add(kind, example, count)
            yield from to_batches([piece.columns for piece in part], rows)

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of the log in parts of about `rows` rows, in file order."""
        return gather(self._messages(), rows)

    def _messages(self) -> Iterator[LocatedMessage]:
        """Yield the messages of the log, in file order."""
        raise NotImplementedError

    def _check_wanted(self) -> None:
        if not self.wanted:
            return
        streams = {stream.name: stream for stream in self.streams()}
        for name in self.wanted:
            if name not in streams:
                hint = near_miss(name, list(streams))
                raise SourceError(f"{self.path}: no stream {name!r} in source.wanted; {hint}")
            if not streams[name].used:
                raise SourceError(
                    f"{self.path}: mapping cannot use stream {name!r} of type "
                    f"{streams[name].type}; remove it from source.wanted"
                )

    def defaults(self) -> Mapping[type[Message], str]:
        """Return the default stream of each kind that may have several streams.

        The source must be open.
        """
        return {}

    def kinds(self) -> frozenset[type[Message]] | None:
        """Return the types of messages in the log; None if they are known only after reading.

        The source must be open, or have been open.
        """
        return None

    def unknown_odometry(self) -> str:
        """Say what in a log without odometry may be odometry, and how to have it read; "" if nothing.

        The source must be open, or have been open.
        """
        return ""

    def missing_scans(self) -> str:
        """Return how to make scans from the data of a log that has none, or "" if that is unknown.

        The source must be open, or have been open.
        """
        return ""

    def explain_emptiness(self) -> str:
        """Return the error for a log without a usable scan: what to do, or its most frequent problem."""
        why = self.missing_scans() or self.most_frequent_problem()
        return f"{self.path}: contains no usable scan; {why or '`imp inspect` lists its contents'}"

    def most_frequent_problem(self, stream: str | None = None) -> str:
        """Return count and first example of the most frequent problem, of a stream if given, or ""."""
        counts, examples = self.problems.counts, self.problems.examples
        kinds = [kind for kind in counts if stream is None or f": {stream}: " in examples[kind]]
        most = max(kinds, key=lambda kind: counts[kind], default="")
        return most and f"{counts[most]} x {most}: {examples[most]}"

    def mounts(self) -> Mapping[str, Mount]:
        """Return the mounts of the lasers according to the log, by the stream of their scans.

        The source must be open, or have been open.
        """
        return {}

    def antennas(self) -> Mapping[str, Mount]:
        """Return the mounts of the antennas of GNSS receivers, by the stream of their fixes.

        The source must be open, or have been open.
        """
        return {}

    def watch_mounts(self, streams: Collection[str]) -> None:
        """Drop scans of these streams while their laser's mount differs from that in `mounts`."""

    def surroundings(self) -> Mapping[str, tuple[float, float]]:
        """Return the minimum and maximum of "temperature" (degrees Celsius) and "humidity" (0 to 1).

        They are only displayed; mapping does not use them.
        """
        return {}

    def true_landmarks(self) -> list[TrueLandmark]:
        """Return the surveyed landmarks that come with the log, in their own frame, for scoring."""
        return []

    @abstractmethod
    def streams(self) -> list[Stream]:
        """Return the streams of the log; the source must be open."""

    @property
    def preset(self) -> str:
        """The preset (or the config, as TOML) that fits this log; the source must be open."""
        return self.default_preset

    @property
    def problems(self) -> Problems:
        """Problems found so far."""
        return self._problems

    @property
    def total(self) -> int | None:
        """Total for a progress bar (messages or bytes), or None if unknown before reading.

        The source must be open.
        """
        return None

    @property
    def position(self) -> int:
        """Progress of the iteration, from 0 to `total`."""
        return 0


_PACKED = {
    b"\x1f\x8b": ("gunzip", ".gz"),
    b"BZh": ("bunzip2", ".bz2"),
    b"\xfd7zXZ": ("unxz", ".xz"),
    b"\x28\xb5\x2f\xfd": ("unzstd", ".zst"),
    b"PK\x03\x04": ("unzip", ""),
    b"7z\xbc\xaf": ("7z x", ""),
}
"""Commands that unpack files, by their first bytes; with the suffix that each requires, or "" if none."""


_LFS_POINTER = b"version https://git-lfs"


def recognise(path: Path) -> type[Source]:
    """Return the source class for the format of a log, detected from its content.

    Raises
    ------
    SourceError
        If the path is missing, empty, a pipe or a device, or of no known format.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder; check the path")
    if not (path.is_file() or path.is_dir()):
        raise SourceError(
            f"{path}: is neither a file nor a folder; copy the data of the pipe or device to a file"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise SourceError(f"{path}: the file is empty; record or copy it again")
    if path.is_dir() and not any(path.iterdir()):
        raise SourceError(f"{path}: the folder is empty; give a log, or the folder of one")
    reasons = []
    for cls in _kinds():
        if cls.recognises(path):
            return cls
        reasons.append(cls.explain_refusal(path))
    if path.is_dir() and (content := explain_folder(path, _is_log)):
        raise SourceError(f"{path}: is not a log; {content}")
    if path.is_file() and (not any(reasons) or _start(path) == _LFS_POINTER):
        reasons = [_explain_start(path)]
    known = ", ".join(names("source"))
    text = f"{path}: no known log format; readable are {known} (see `imp list`)"
    others = ["write stamps, poses and ranges of another format as CSV (docs/formats.md)"]
    raise SourceError("; ".join([text, *(list(filter(None, reasons)) or others)]))


def _kinds() -> Iterator[type[Source]]:
    """Yield all sources, one by one, so that a text log does not import the bag readers."""
    for name in names("source"):
        cls = find("source", name)
        if issubclass(cls, Source):
            yield cls


def _is_log(path: Path) -> bool:
    """Return whether an entry of a folder is a log, as far as it can be read."""
    with suppress(ImpError, OSError):
        is_filled = path.is_dir() or (path.is_file() and path.stat().st_size > 0)
        return is_filled and any(cls.recognises(path) for cls in _kinds())
    return False


def _start(path: Path) -> bytes:
    """Return the first bytes of a file, as many as show what it is."""
    with path.open("rb") as file:
        return file.read(len(_LFS_POINTER))


def _explain_start(path: Path) -> str:
    """Say what the first bytes of a file show: that it is packed, elsewhere, or was not written."""
    start = _start(path)
    if start == _LFS_POINTER:
        return "it is a pointer to a file in Git LFS; `git lfs pull` in its repository gets the log"
    if not any(start):
        return "it begins with zeros: writing was interrupted, or the disk lost the data"
    found = next((how for magic, how in _PACKED.items() if start.startswith(magic)), None)
    return f"it is packed; unpack it first: {_unpacking(*found, path)}" if found else ""


def _unpacking(command: str, suffix: str, path: Path) -> str:
    """Return the line that unpacks a file; some commands refuse other suffixes than their own."""
    if ".tar" in path.suffixes or path.suffix == ".tgz":
        return f"tar xf {path}"
    if suffix and path.suffix != suffix:
        return f"{command} -c {path} > {path}.unpacked"
    return f"{command} -k {path}" if suffix else f"{command} {path}"
