"""The data of a log that a calibration needs: odometry readings, scans and yaw rates, on one time line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.columns import Batch, Columns, join, same_layout
from impslam.config import Config
from impslam.errors import ConfigError
from impslam.odometry.clocks import MAX_UNTIMED
from impslam.odometry.stream_clocks import StreamClocks
from impslam.robot import Robot
from impslam.sensors.lidar2d import Lidar2D
from impslam.sources.base import Source
from impslam.streams import Reader, Streams
from impslam.types import Array, Imu, LaserScan, Message, TruePose


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRows:
    """The rows of a log that a calibration reads, in pieces of one layout each.

    Attributes
    ----------
    odometry : readings of odometry; empty if the log has none
    scans : sweeps of one lidar
    gyro : (g, 2) s and rad/s, the yaw rates of an inertial unit
    truth : (t, 4) s, m, m, rad, true poses of base_link; for scoring
    untimed : whether many rows of odometry or scans have unusable stamps (see `odometry.clocks`)
    """

    odometry: tuple[Columns, ...]
    scans: tuple[Columns, ...]
    gyro: Array
    truth: Array
    untimed: bool = False


def lidars_of(robot: Robot) -> dict[str, Lidar2D]:
    """Return the robot's lidars by name."""
    return {name: one for name, one in robot.sensors.items() if isinstance(one, Lidar2D)}


def first_lidar(config: Config) -> tuple[str, Lidar2D]:
    """Return the name of the config's first lidar, and the lidar.

    Raises
    ------
    ConfigError
        If there is none.
    """
    for name, lidar in lidars_of(config.make_robot()).items():
        return name, lidar
    raise ConfigError(
        "sensors: no lidar2d to compare odometry with; add one with --set sensors.lidar.kind=lidar2d"
    )


def record(
    config: Config, source: Source, progress: Callable[[], object] = lambda: None
) -> CalibrationRows:
    """Read a log; call `progress` after each batch. See `record_batches`."""
    with source:
        streams = _streams(config)
        batches = _with_progress(streams.read(source), progress)
        return _record(streams, first_lidar(config)[0], batches)


def record_batches(
    config: Config,
    batches: Iterable[Batch],
    defaults: Mapping[type[Message], str] | None = None,
    lidar: str = "",
) -> CalibrationRows:
    """Return the rows of the config's odometry and one lidar, and of any inertial unit.

    Clock steps are corrected as in a run, so that all stamps are on one time line. `defaults` are the
    streams to read if the config names none; see `Source.defaults`. `lidar` is a name; "" for the first.
    """
    streams = _streams(config)
    streams.choose(defaults or {})
    return _record(streams, lidar or first_lidar(config)[0], batches)


def _with_progress(batches: Iterable[Batch], progress: Callable[[], object]) -> Iterable[Batch]:
    for batch in batches:
        yield batch
        progress()


def _streams(config: Config) -> Streams:
    robot = config.make_robot()
    return Streams(
        Reader("odometry", robot.odometry.consumes, robot.odometry.stream),
        {
            name: Reader(f"sensors.{name}", LaserScan, lidar.stream)
            for name, lidar in lidars_of(robot).items()
        },
    )


def _record(streams: Streams, name: str, batches: Iterable[Batch]) -> CalibrationRows:
    clocks, kept, by_order = StreamClocks(), dict[str, list[Columns]](), Counter[str]()
    for batch in batches:
        used = streams.used(batch)
        read = {streams.odometry.stream, streams.sensors[name].stream}
        rows = [c for c in batch.values() if c.kind in (Imu, TruePose) and len(c)]
        rows += [c for c in used if c not in rows and c.stream in read]
        found, _ = clocks.place(rows, streams.odometry.stream)
        for columns, placed in zip(rows, found, strict=True):
            by_order[columns.stream] += int(placed.by_order.sum())
            kept.setdefault(columns.stream, []).append(columns.with_stamps(placed.times))
    lidar = streams.sensors[name]
    every = [columns for pieces in kept.values() for columns in pieces]
    names = {streams.odometry.stream, lidar.stream} & kept.keys()
    untimed = any(by_order[n] > MAX_UNTIMED * sum(map(len, kept[n])) for n in names)
    return CalibrationRows(
        _joined(kept.get(streams.odometry.stream, [])),
        tuple(c for c in _joined(kept.get(lidar.stream, [])) if len(c["angles"])),
        _table([c for c in every if c.kind is Imu], lambda c: c["angular_velocity"][:, 2:], 2),
        _table([c for c in every if c.kind is TruePose], lambda c: c["pose"], 4),
        untimed,
    )


def _joined(pieces: Iterable[Columns]) -> tuple[Columns, ...]:
    """Return the pieces, with adjacent ones of the same layout joined."""
    runs: list[list[Columns]] = []
    for piece in pieces:
        if runs and same_layout(runs[-1][0], piece):
            runs[-1].append(piece)
        else:
            runs.append([piece])
    return tuple(_join_all(run) for run in runs)


def _join_all(run: Sequence[Columns]) -> Columns:
    """Join pieces of one layout; recursively by halves, so that each row is copied few times."""
    if len(run) == 1:
        return run[0]
    middle = len(run) // 2
    return join(_join_all(run[:middle]), _join_all(run[middle:]))


def _table(pieces: Sequence[Columns], values: Callable[[Columns], Array], width: int) -> Array:
    rows = [np.column_stack((columns.stamps, values(columns))) for columns in pieces]
    return np.concatenate(rows) if rows else np.empty((0, width))
