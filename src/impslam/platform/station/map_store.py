"""The maps on the robot's disk: a folder each, and a recycle bin for deleted ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from impslam.errors import ImpError
from impslam.maps import archive
from impslam.platform.station.store import MAPS, Store, StoreError

FILE = "map.imp"
REPORT = "report.html"


@dataclass(frozen=True, slots=True)
class StoredMap:
    """A map on the disk.

    Attributes
    ----------
    name : name of its folder
    size : bytes of the map file
    modified : s since 1970, when it was last written
    scans : number of scans in it
    mapping : whether it is being made
    report : whether it was saved with a report and pictures
    damage : one line: why the file cannot be read, "" if it can
    """

    name: str
    size: int
    modified: float
    scans: int
    mapping: bool
    report: bool
    damage: str = ""


class MapStore(Store):
    """The maps in a folder; every method may be called from any thread.

    Parameters
    ----------
    folder : where maps are kept; it may be missing, and maps may vanish at any time
    making : returns the name of the map that is being made, "" if none is
    deleted : called with the name of a map after it is deleted
    """

    def __init__(
        self,
        folder: Path,
        making: Callable[[], str] = lambda: "",
        deleted: Callable[[str], None] = lambda name: None,
    ) -> None:
        super().__init__(folder, MAPS)
        self._making, self._deleted = making, deleted
        self._cache: dict[str, tuple[tuple[int, int], int, str]] = {}

    def maps(self) -> list[StoredMap]:
        """Return the maps, newest first."""
        found = [self._describe(name) for name, _ in self.entries()]
        return sorted(filter(None, found), key=lambda one: (-one.modified, one.name))

    def delete(self, name: str) -> None:
        """Move a map to the recycle bin.

        Raises
        ------
        StoreError
            If there is no such map, it is being made, or the disk refuses.
        """
        if self.path(name).name == self._making():
            raise StoreError(f"{name}: is the map in progress; begin a new map before deleting it")
        self.discard(name)
        self._deleted(name)

    def _describe(self, name: str) -> StoredMap | None:
        """Return the description of a map; the file is read once per version."""
        folder = self.folder / name
        try:
            status = (folder / FILE).lstat()
            report = (folder / REPORT).exists()
        except OSError:  # not a map, or it has vanished
            return None
        version = status.st_size, status.st_mtime_ns
        cached = self._cache.get(name)
        if cached is None or cached[0] != version:
            cached = self._cache[name] = version, *_scans(folder / FILE)
        _, scans, damage = cached
        making = name == self._making()
        return StoredMap(name, status.st_size, status.st_mtime, scans, making, report, damage)


def _scans(path: Path) -> tuple[int, str]:
    """Return the number of scans in a map, and why its file cannot be read, or ""."""
    try:
        logs = archive.about(path).get("logs", [])
        return sum(int(log["scans"]) for log in logs), ""
    except ImpError as error:
        return 0, str(error)
    except (KeyError, TypeError, ValueError):  # written by an earlier version
        return 0, ""
