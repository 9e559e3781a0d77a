"""The maps of all particles: tables of copy-on-write tiles.

Particles with the same parent share the whole map. When their paths diverge, the table is copied (one
number per tile), and a tile when one of them writes to it.
"""

from __future__ import annotations

import numpy as np

from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import MAX_POINTS
from impslam.surfaces.tiles import Tiles, add_to_tiles, begin, copy, empty_tiles, touched_tiles
from impslam.types import Array, Ints

_POOL = 64  # tiles; the pool grows by doubling
_SPARE = 4  # rows and columns of tiles that a table grows by


class SharedMaps:
    """M maps of P particles.

    Attributes
    ----------
    maps : (P,) index of the map of each particle
    tables : (M, rows, columns) index of the tile at each place, -1 for none
    origin : (2,) column and row of the first tile of the tables
    tiles, users : the pool, and the number of maps that use each of its tiles
    """

    def __init__(self, particles: int) -> None:
        self.maps: Ints = np.zeros(particles, np.int64)
        self.tables: Ints = np.full((1, 1, 1), -1)
        self.origin: Ints = np.zeros(2, np.int64)
        self.tiles: Tiles = empty_tiles(_POOL)
        self.users: Ints = np.zeros(_POOL, np.int64)

    @property
    def used(self) -> int:
        """Number of distinct tiles of all maps."""
        return int(np.count_nonzero(self.users))

    def resample(self, parents: Ints) -> None:
        """Replace the particles by their parents (P,), and remove unused maps."""
        self.maps = self.maps[parents]
        kept, self.maps = np.unique(self.maps, return_inverse=True)
        self.tables = self.tables[kept]
        self._count()

    def add(self, features: Features, poses: Array, lines: Ints) -> None:
        """Add a scan to all maps, at the particles' poses (P, 3).

        Particles of one lineage (P,) have the same pose and the same map.
        """
        _, first, group = np.unique(lines, return_index=True, return_inverse=True)
        tables = self.tables[self.maps[first]]  # a copy for each lineage
        self.tables, self.maps = tables, group.astype(np.int64)
        self._count()
        for k, pose in enumerate(poses[first]):
            self._write(k, features, pose)

    def _write(self, k: int, features: Features, pose: Array) -> None:
        places = touched_tiles(features, pose)
        if not len(places):
            return
        self._cover(places)
        columns, rows = (places - self.origin).T
        known = self.tables[k, rows, columns]
        shared = np.flatnonzero((known < 0) | (self.users[known] > 1))
        free = self._free(len(shared))
        for at, new in zip(shared.tolist(), free.tolist(), strict=True):
            old = int(known[at])
            if old < 0:
                begin(self.tiles, new, *places[at].tolist())
            else:
                copy(self.tiles, old, self.tiles, new)
                self.users[old] -= 1
            self.users[new] = 1
        known[shared] = free
        self.tables[k, rows, columns] = known
        add_to_tiles(self.tiles, known, features, pose, MAX_POINTS)

    def _cover(self, places: Ints) -> None:
        """Extend the tables to include some places (n, 2), column and row."""
        low, high = places.min(0), places.max(0) + 1
        shape = np.array(self.tables.shape[:0:-1])
        before = np.where(low < self.origin, self.origin - low + _SPARE, 0)
        after = np.where(high > self.origin + shape, high - self.origin - shape + _SPARE, 0)
        if before.any() or after.any():
            (left, below), (right, above) = before.tolist(), after.tolist()
            pad = ((0, 0), (below, above), (left, right))
            self.tables = np.pad(self.tables, pad, constant_values=-1)
            self.origin = self.origin - before

    def _count(self) -> None:
        used = self.tables[self.tables >= 0]
        self.users = np.bincount(used, minlength=len(self.users))

    def _free(self, wanted: int) -> Ints:
        free = np.flatnonzero(self.users == 0)
        while len(free) < wanted:
            old, grown = len(self.users), empty_tiles(2 * len(self.users))
            for k in np.flatnonzero(self.users).tolist():
                copy(self.tiles, k, grown, k)
            self.tiles, self.users = grown, np.concatenate([self.users, np.zeros(old, np.int64)])
            free = np.flatnonzero(self.users == 0)
        return free[:wanted]
