"""One face for the storages of rosbags: ROS 1 bags, ROS 2 folders, MCAP and SQLite files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from impslam.errors import SourceError

Storage: TypeAlias = rosbag1.Reader | rosbag2.Reader | McapReader | Sqlite3Reader
RosMessage: TypeAlias = Any  # classes that rosbags makes at run time from the log's definitions

_MAGIC: dict[bytes, Callable[[Path], Storage]] = {
    b"#ROSBAG V": rosbag1.Reader,
    b"\x89MCAP0\r\n": McapReader,
    b"SQLite format 3\0": Sqlite3Reader,
}
_REPAIR = "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or copy it again"


def storage_class(path: Path) -> Callable[[Path], Storage] | None:
    """Return what reads a file, by its first bytes, or a folder, by its metadata.yaml."""
    if path.is_dir():
        return rosbag2.Reader if (path / "metadata.yaml").is_file() else None
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return None
    return next((cls for magic, cls in _MAGIC.items() if start.startswith(magic)), None)


def one_line(error: BaseException) -> str:
    """Return what an error of rosbags says, on one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class Bag:
    """An open bag of any kind; `SourceError` if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        make = storage_class(path)
        if make is None:
            raise SourceError(f"{path}: neither a ROS bag nor MCAP; see `imp list` for formats")
        try:
            self._storage = make(path)
            self._storage.open()
        except Exception as error:  # a damaged index leads rosbags to raise anything
            raise SourceError(f"{path}: cannot be opened ({one_line(error)}); {_REPAIR}") from None
        self.is_ros1 = make is rosbag1.Reader

    def close(self) -> None:
        """Close the storage."""
        self._storage.close()

    @property
    def connections(self) -> list[Connection]:
        """What was recorded, one entry per topic and publisher."""
        return self._storage.connections

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, log time in ns, data) in the order of log time."""
        return self._storage.messages(connections)

    def decoder(self, connection: Connection) -> Callable[[bytes], RosMessage]:
        """Return what turns a connection's data into messages."""
        store, kind = self._types(connection), connection.msgtype
        if self.is_ros1:
            return lambda data: store.deserialize_ros1(data, kind)
        return lambda data: store.deserialize_cdr(data, kind)

    def _types(self, connection: Connection) -> Typestore:
        """Return the definitions in the log, else those of the standard types."""
        text, form = connection.msgdef.data, connection.msgdef.format
        standard = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.LATEST)
        if not text.strip():
            return standard
        with suppress(Exception):  # what rosbags cannot parse may be a standard type yet
            store = get_typestore(Stores.EMPTY)
            if form == MessageDefinitionFormat.MSG:
                store.register(get_types_from_msg(text, connection.msgtype))
            else:
                store.register(get_types_from_idl(text))
            store.get_msgdef(connection.msgtype)
            return store
        return standard
