"""The ROS 2 bag readers of rosbags with size limits: folders of files, with or without metadata.yaml."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from impslam.sources.folders import numbered_pieces
from impslam.sources.mcap_reader import CutMcapReader
from impslam.sources.ros1_files import merged
from impslam.sources.unpack import UNIT_LIMIT, check_unpacked, unpack_file


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


PACKED = ".zstd"
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
            if path.suffix == PACKED:
                check_unpacked(path, shutil.disk_usage(tempfile.gettempdir()).free // 2)
        super().open()
        self.is_cut = any(isinstance(f, CutMcapReader) and f.is_cut for f in self.storages)
        self.metadata = self.metadata._replace(compression_mode=None)  # `Bag` unpacks messages


class UnlistedFolder(BagFolder):
    """A ROS 2 bag whose recorder was killed before it wrote metadata.yaml."""

    is_cut = True

    def __init__(self, path: Path) -> None:
        self.path, self.stack = path, None
        self.connections, self.files, self.storages = [], [], []
        self.metadata = ReaderMetadata(0, 2**63 - 1, 0, 0, None, None, None, None)

    @staticmethod
    def pieces(path: Path) -> list[Path]:
        """Return the files of a bag in order, NAME_0, NAME_1, ...; none if there are others.

        A recorder that was killed while it compressed a file has left both; the compressed one is cut.
        """
        found: dict[Path, Path] = {}
        for packed in (PACKED, ""):
            for suffix in _PIECES:
                files = path.glob(f"*{suffix}{packed}")
                found |= {Path(str(f).removesuffix(packed)): f for f in files if f.is_file()}
        names = numbered_pieces(found) if len(found) > 1 else list(found)
        return [found[name] for name in names]

    def open(self) -> None:
        """Open the files."""
        self.stack = ExitStack()
        try:
            folder = Path(self.stack.enter_context(tempfile.TemporaryDirectory()))
            for file in self.pieces(Path(str(self.path))):
                path = unpack_file(file, folder) if file.suffix == PACKED else file
                storage = _PIECES[path.suffix](path)
                storage.open()
                self.stack.callback(storage.close)
                self.storages.append(storage)
        except BaseException:
            self.close()
            raise
        self.connections = list(merged(self.storages).values())


_PIECES: dict[str, Any] = {".mcap": CutMcapReader, ".db3": PlainSqlite3Reader}
