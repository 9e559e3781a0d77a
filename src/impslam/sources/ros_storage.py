"""A common interface to ROS logs: ROS 1 bags, ROS 2 folders, MCAP and SQLite files."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from rosbags.interfaces import Connection, Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from impslam.errors import SourceError
from impslam.sources.mcap_reader import MAGIC, CutMcapReader, ForeignError
from impslam.sources.ros1_files import BoundedReader1, SplitReader1
from impslam.sources.ros_files import BagFolder, PlainSqlite3Reader, UnlistedFolder
from impslam.sources.unpack import ZSTD_MAGIC, LimitError, unpack_zstd

Storage: TypeAlias = BoundedReader1 | SplitReader1 | BagFolder | CutMcapReader | PlainSqlite3Reader
RosMessage: TypeAlias = Any  # rosbags creates the classes at run time

_MAGIC: dict[bytes, Callable[[Path], Storage]] = {
    b"#ROSBAG V": BoundedReader1,
    MAGIC: CutMcapReader,
    b"SQLite format 3\0": PlainSqlite3Reader,
}
_EARLY = re.compile(
    rb"#ROS(?:LOG|RECORD) V(\d\.\d)\n"
)  # the file FORMATS of the ROS package rosbag
_TRANSFORMS: Any = (
    [],
    [
        (
            "transforms",
            (Nodetype.SEQUENCE, ((Nodetype.NAME, "geometry_msgs/msg/TransformStamped"), 0)),
        )
    ],
)
_REPAIR = "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or copy it again"


METADATA, METADATA_KEY = "metadata.yaml", b"rosbag2_bagfile_information"


def folder_of(path: Path) -> Path:
    """Return the folder of a ROS 2 bag whose metadata.yaml is given; other paths as they are."""
    if path.name != METADATA or not path.is_file():
        return path
    with path.open("rb") as file:
        return path.parent if METADATA_KEY in file.read(4096) else path


def storage_class(path: Path) -> Callable[[Path], Storage] | None:
    """Return the reader of a file, by its first bytes, or of a folder, by its metadata.yaml or files."""
    if path.is_dir():
        if (path / METADATA).is_file():
            return BagFolder
        folders = (UnlistedFolder, SplitReader1)
        return next((cls for cls in folders if cls.pieces(path)), None)
    start = _start(path)
    return next((cls for magic, cls in _MAGIC.items() if start.startswith(magic)), None)


def early_version(path: Path) -> str:
    """Return the version of a ROS 1 bag from before version 2.0, by its first line; "" of other paths."""
    found = _EARLY.match(_start(path))
    return found[1].decode("ascii") if found else ""


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; none if it cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(16)
    return b""


def one_line(error: BaseException) -> str:
    """Return the message of an error of rosbags on one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class Bag:
    """An open bag of any kind; raises `SourceError` if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        make = storage_class(path)
        if make is None:
            raise SourceError(f"{path}: neither a ROS bag nor MCAP; see `imp list` for formats")
        try:
            self._storage = make(path)
            self._storage.open()
        except LimitError as error:
            raise _too_large(path, error) from None
        except ForeignError as error:
            raise SourceError(
                f"{path}: is an MCAP file, but not of ROS 2 ({one_line(error)}); give the ROS 1 bag that "
                "it was made of, or write its scans and odometry as messages of ROS 2 or as CSV"
            ) from None
        except Exception as error:  # rosbags may raise anything on a damaged index
            raise SourceError(f"{path}: cannot be opened ({one_line(error)}); {_REPAIR}") from None
        self._path, self.is_ros1 = path, make in (BoundedReader1, SplitReader1)
        self.is_cut = not isinstance(self._storage, PlainSqlite3Reader) and self._storage.is_cut

    def close(self) -> None:
        """Close the storage."""
        self._storage.close()

    @property
    def connections(self) -> list[Connection]:
        """The recorded connections, one per topic and publisher."""
        return self._storage.connections

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, log time in ns, data) in order of log time.

        Data of ROS 2 begin with a zero byte, unless the recorder has compressed each message.
        """
        try:
            for connection, time, data in self._storage.messages(connections):
                packed = data[:4] == ZSTD_MAGIC and not self.is_ros1
                yield connection, time, unpack_zstd(data) if packed else data
        except LimitError as error:
            raise _too_large(self._path, error) from None

    @property
    def damage(self) -> str:
        """What is wrong with a file that is cut."""
        if isinstance(self._storage, UnlistedFolder):
            return f"has no {METADATA}: the recorder was killed, or it was not copied"
        return "is truncated (power loss, or still being recorded)"

    @property
    def repair(self) -> str:
        """The command that repairs a truncated file."""
        if self.is_ros1:
            return "rosbag reindex"
        return "ros2 bag reindex" if isinstance(self._storage, BagFolder) else "mcap recover"

    @property
    def types(self) -> Typestore:
        """The standard message types."""
        return _standard_types(self.is_ros1)

    def decoder(self, connection: Connection) -> Callable[[bytes], RosMessage]:
        """Return a function that deserialises a connection's data.

        It uses the standard types, the same since ROS 1 except for the header. Definitions in the log
        are ignored, because rosbags generates code from them.
        """
        kind, store = connection.msgtype, self.types
        if self.is_ros1:
            return lambda data: store.deserialize_ros1(data, kind)
        return lambda data: store.deserialize_cdr(data, kind)


@lru_cache
def _standard_types(is_ros1: bool) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    if is_ros1:  # rosbags lacks the types of tf2 and tf
        store.register(dict.fromkeys(("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), _TRANSFORMS))
    return store


def _too_large(path: Path, error: LimitError) -> SourceError:
    return SourceError(
        f"{path}: has {error}, more than any robot records; check its origin, or rewrite it in chunks "
        "of a few MB (`mcap compress --chunk-size 4194304`)"
    )
