"""Drives for fault injection: a few minutes of odometry and scans as columns, with the truth.

A drive is simulated, with the truth, or it is the beginning of a log. It is mapped in the same way as a log
by `imp run`, through a source.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Columns, batches, join
from impslam.config import Config, load
from impslam.open_log import open_log
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.base import Source, Stream
from impslam.sources.parts import Piece
from impslam.types import Array, Ints, LaserScan, Mask, Message, TruePose

SECONDS = 150.0
"""s of a log that are used: some 40 m of driving, with loops in each of the logs."""


class RecordedDrive(NamedTuple):
    """The recording of a drive.

    Attributes
    ----------
    path : file of the log, or of the world
    config : config for mapping
    odometry, scans : m rows and n rows; a row's `order` is its place in the log. Without odometry m is 0
    truth : (n, 3) `T_map_base` at each row of scans, NaN if unknown
    """

    path: Path
    config: Config
    odometry: Columns
    scans: Columns
    truth: Array

    @property
    def period(self) -> float:
        """Median time between scans, s; stamps may jump."""
        return float(np.median(np.abs(np.diff(self.scans.stamps))))

    def rows(self, seconds: float) -> int:
        """Return the number of scans in a time in s, at least one."""
        return max(1, round(seconds / self.period))

    def after(self, row: int) -> Mask:
        """Return (m,) which rows of odometry come after a row of scans."""
        last = self.scans.order[-1] + 1 if row >= len(self.scans) else self.scans.order[row]
        return np.asarray(self.odometry.order >= last)

    def keep(self, scans: Mask | Ints | slice, odometry: Mask | Ints | slice) -> RecordedDrive:
        """Return the drive with some of the rows."""
        return self._replace(
            odometry=self.odometry.take(odometry),
            scans=self.scans.take(scans),
            truth=self.truth[scans],
        )

    def with_scans(self, **values: Array) -> RecordedDrive:
        """Return the drive with other values of its scans, such as `ranges` (n, beams)."""
        return self._replace(scans=with_values(self.scans, **values))


def with_values(columns: Columns, **values: Array) -> Columns:
    """Return columns with some of their values changed."""
    return replace(columns, values={**columns.values, **values})


def numbered(drive: RecordedDrive) -> RecordedDrive:
    """Return the drive with unique orders of the rows; at equal orders, odometry comes first."""
    orders = np.concatenate((drive.odometry.order, drive.scans.order))
    unique = np.empty(len(orders), np.int64)
    unique[np.argsort(orders, kind="stable")] = np.arange(len(orders))
    m = len(drive.odometry)
    odometry, scans = unique[:m], unique[m:]
    return drive._replace(
        odometry=replace(drive.odometry, order=odometry), scans=replace(drive.scans, order=scans)
    )


class DriveSource(Source):
    """A source that provides a drive like a log."""

    _drive: RecordedDrive = PrivateAttr()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return False: this source does not read files."""
        del path
        return False

    @classmethod
    def of(cls, drive: RecordedDrive) -> Self:
        """Return the source of a drive."""
        source = cls(path=drive.path)
        source._drive = numbered(drive)
        return source

    @property
    def drive(self) -> RecordedDrive:
        """The drive, with unique orders of its rows."""
        return self._drive

    def __enter__(self) -> Self:
        """Do nothing."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def kinds(self) -> frozenset[type[Message]]:
        """Return the types of its messages."""
        return frozenset(columns.kind for columns in self._columns())

    def streams(self) -> list[Stream]:
        """Return its streams."""
        return [Stream(c.stream, c.kind.__name__, len(c), used=True) for c in self._columns()]

    def _columns(self) -> list[Columns]:
        return [c for c in (self._drive.odometry, self._drive.scans) if len(c)]

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        del rows  # all of it is in memory
        yield [Piece.of(columns, columns.order) for columns in self._columns()]


def simulated(world: str, seed: int, settings: Sequence[str] = ()) -> RecordedDrive:
    """Simulate the robot of the thesis in a shipped world."""
    known = load_world(world)
    config = load("imp", [f"start={list(map(float, known.robot.start))}", *settings])
    recorded = simulate(known, SimulatedRobot(imu=None, truth_rate=1.0), seed)
    (batch,) = batches(((type(m).__name__, m) for m in recorded), rows=10**9)
    odometry, scans = batch[config.make_robot().odometry.consumes.__name__], batch["LaserScan"]
    truth = batch[TruePose.__name__]
    rows = np.searchsorted(truth.stamps, scans.stamps)
    path = Path(str(files("impslam.simulation.worlds") / f"{world}.toml"))
    return RecordedDrive(path, config, odometry, scans, truth["pose"][rows])


def recorded(log: Path, config: str | None = None, seconds: float = SECONDS) -> RecordedDrive:
    """Read the first seconds of a log; the truth is unknown."""
    chosen, source = open_log(log, config)
    consumed = chosen.make_robot().odometry.consumes
    found: dict[type[Message], list[Columns]] = {LaserScan: [], consumed: []}
    with source:
        defaults = source.defaults()
        for batch in source.batches():
            for columns in batch.values():
                if columns.stream == defaults.get(columns.kind, columns.stream):
                    found.get(columns.kind, []).append(columns)
    scans, odometry = (reduce(join, found[kind]) for kind in (LaserScan, consumed))
    steps = np.clip(np.diff(scans.stamps, prepend=scans.stamps[0]), 0.0, 1.0)
    scans = scans.take(np.cumsum(steps) < seconds)
    odometry = odometry.take(odometry.order <= scans.order[-1])
    return RecordedDrive(log, chosen, odometry, scans, np.full((len(scans), 3), math.nan))


def metres_per_reading(odometry: Mapping[str, Any]) -> float:
    """Return the distance in m per unit of a wheel's reading, for the odometry table of a config."""
    radius, turn = odometry.get("wheel_radius", 1.0), odometry.get("per_turn", 2.0 * math.pi)
    return float(2.0 * math.pi * radius / turn)
