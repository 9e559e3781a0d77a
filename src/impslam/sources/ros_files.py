"""The ROS 2 bag readers of rosbags with size limits: folders of files, with or without metadata.yaml."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Generator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from impslam.sources.folders import numbered_pieces
from impslam.sources.mcap_reader import CutMcapReader
from impslam.sources.ros1_files import merged
from impslam.sources.unpack import UNIT_LIMIT, check_unpacked, unpack_zstd


class PlainSqlite3Reader(Sqlite3Reader):
    """An SQLite file of plain tables: views, triggers and computed columns are rejected.

    A recorder that was killed leaves its newest messages in a write-ahead log beside the file. rosbags does
    not read it, as it opens files as immutable, so both are merged in a temporary copy.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._original, self._copies = path, ExitStack()

    def open(self) -> None:
        """Open the file."""
        log = Path(f"{self._original}-wal")
        try:
            if log.is_file() and log.stat().st_size > 0:
                self.path = self._merged(log)
            super().open()
        except BaseException:
            self._copies.close()
            raise

    def close(self) -> None:
        """Close the file."""
        super().close()
        self.path = self._original
        self._copies.close()

    def _merged(self, log: Path) -> Path:
        """Return a temporary copy of the file that contains its write-ahead log."""
        size = sum(path.stat().st_size for path in (self._original, log))
        if size > shutil.disk_usage(tempfile.gettempdir()).free // 2:
            raise ReaderError(f"There is no space for a temporary copy with {log.name!r}.")
        folder = Path(self._copies.enter_context(tempfile.TemporaryDirectory()))
        for path in (self._original, log):
            shutil.copyfile(path, folder / path.name)
        copy = folder / self._original.name
        with closing(sqlite3.connect(copy)) as database:
            database.execute("PRAGMA journal_mode=DELETE")  # merges the log
        return copy

    def _open(self) -> None:
        assert self.dbconn is not None
        self.dbconn.limit(_SQLITE_LIMIT_LENGTH, UNIT_LIMIT)
        if computed := next(self.dbconn.execute(_COMPUTED), None):
            raise ReaderError(f"{computed[0]!r} is computed, not recorded.")
        super()._open()


_SQLITE_LIMIT_LENGTH = 0  # id of the limit on the length of a text or a blob
_COMPUTED = """
    SELECT m.name FROM sqlite_master m LEFT JOIN pragma_table_xinfo(m.name) c
    WHERE m.type NOT IN ('table', 'index') OR m.sql LIKE 'CREATE VIRTUAL%' OR c.hidden LIMIT 1"""


class BagFolder(DirectoryReader):
    """A ROS 2 bag: a folder of files of one kind, listed in its metadata.yaml."""

    is_cut = False
    STORAGE_PLUGINS = {"mcap": CutMcapReader, "sqlite3": PlainSqlite3Reader}  # noqa: RUF012

    def open(self) -> None:
        """Open the files; compressed ones are first unpacked to a temporary folder."""
        for path in Path(str(self.path)).iterdir():
            if path.exists() and not (path.is_file() or path.is_dir()):
                raise ReaderError(f"{path.name!r} is neither a file nor a folder.")
            if path.suffix == ".zstd":
                check_unpacked(path, shutil.disk_usage(tempfile.gettempdir()).free // 2)
        super().open()
        self.is_cut = any(isinstance(f, CutMcapReader) and f.is_cut for f in self.storages)
        self._packs_messages = self.metadata.compression_mode == "message"
        self.metadata = self.metadata._replace(compression_mode=None)  # see `messages`

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield (connection, log time in ns, data)."""
        for connection, stamp, data in super().messages(connections, start, stop):
            yield connection, stamp, unpack_zstd(data) if self._packs_messages else data


class UnlistedFolder(BagFolder):
    """A ROS 2 bag whose recorder was killed before it wrote metadata.yaml."""

    is_cut = True

    def __init__(self, path: Path) -> None:
        self.path, self.stack = path, None
        self.connections, self.files, self.storages = [], [], []
        self.metadata = ReaderMetadata(0, 2**63 - 1, 0, 0, None, None, None, None)
        self._packs_messages = False

    @staticmethod
    def pieces(path: Path) -> list[Path]:
        """Return the files of a bag in order, NAME_0, NAME_1, ...; none if there are others."""
        found = [file for suffix in _PIECES for file in path.glob(f"*{suffix}") if file.is_file()]
        return numbered_pieces(found) if len(found) > 1 else found

    def open(self) -> None:
        """Open the files."""
        self.stack = ExitStack()
        try:
            for path in self.pieces(Path(str(self.path))):
                storage = _PIECES[path.suffix](path)
                storage.open()
                self.stack.callback(storage.close)
                self.storages.append(storage)
        except BaseException:
            self.close()
            raise
        self.connections = list(merged(self.storages).values())


_PIECES: dict[str, Any] = {".mcap": CutMcapReader, ".db3": PlainSqlite3Reader}
