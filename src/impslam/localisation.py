"""Localise the single scans of a log in a map."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from impslam.columns import Motions, Sweeps
from impslam.config import Config
from impslam.errors import ConfigError, SourceError
from impslam.geometry.se2 import compose
from impslam.map import Map, check_map
from impslam.open_log import open_log
from impslam.recognition.relocalisation import Answer, Relocaliser
from impslam.recognition.submap import view
from impslam.robot import Robot
from impslam.sources.base import Source
from impslam.types import Array, Scan

Progress = Callable[[int, int | None], None]
"""Called with the position in the log and the length of the log, or None if the length is unknown."""


class Located(NamedTuple):
    """The result for one scan.

    Attributes
    ----------
    stamp : s, as in the log
    pose : (3,) `T_map_base` at the stamp by the best hypothesis; None if there is none
    answer : all hypotheses, with `T_map_base` at the middle of the sweep
    seconds : duration of the search
    """

    stamp: float
    pose: Array | None
    answer: Answer
    seconds: float


def localise(
    known: Map,
    log: str | Path,
    config: str | Path | Config | None = None,
    settings: Sequence[str] = (),
    *,
    every: int = 1,
    progress: Progress = lambda position, total: None,
) -> Iterator[Located]:
    """Localise the scans of a log in a map, each one independently.

    Parameters
    ----------
    known : the map
    log : a file or folder; its format is detected from its content
    config : a preset's name, a file, or a config; by default the preset that fits the log
    settings : overrides of the config, each as "key=value"
    every : localise only every n-th scan
    progress : called with the position in the log and its length, in the source's own unit

    Raises
    ------
    ConfigError
        If `known` is not a map, or `every` is not positive.
    SourceError
        If the log cannot be read, or, at the end, contains no scan.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import impslam
    >>> from impslam.localisation import localise
    >>> from impslam.simulation.robot import SimulatedRobot
    >>> from impslam.simulation.simulate import simulate
    >>> from impslam.simulation.world import load_world
    >>> from impslam.sources.recording import McapWriter
    >>> log = Path(tempfile.mkdtemp()) / "room.mcap"
    >>> with McapWriter(log) as writer:
    ...     for message in simulate(load_world("room"), SimulatedRobot(imu=None)):
    ...         writer.write(message)
    >>> known = impslam.run(log, "imp")
    >>> found = list(localise(known, log, "imp", every=20))
    >>> {located.answer.verdict.value for located in found} <= {"found", "ambiguous"}
    True
    """
    check_map("known", known)
    if every < 1:
        raise ConfigError(f"every = {every}: expected 1 or more")
    chosen, source = open_log(log, config, settings)
    return _localised(known, chosen.make_robot(), source, every, progress)


def _localised(
    known: Map, robot: Robot, source: Source, every: int, progress: Progress
) -> Iterator[Located]:
    relocaliser = Relocaliser(known.keyframes)
    count = -1
    for count, (stamp, scan, T_middle_stamp) in enumerate(_scans(robot, source)):
        progress(source.position, source.total)
        if count % every:
            continue
        begin = time.perf_counter()
        answer = relocaliser.find(view(scan))
        seconds = time.perf_counter() - begin
        best = compose(answer.hypotheses[0].pose, T_middle_stamp) if answer.hypotheses else None
        yield Located(stamp, best, answer, seconds)
    if count < 0:
        raise SourceError(source.explain_emptiness())


def _scans(robot: Robot, source: Source) -> Iterator[tuple[float, Scan, Array]]:
    """Yield stamp, scan and the motion (3,) from the middle of its sweep to the stamp."""
    with source:
        for batch in robot.streams.read(source):
            yield from _rows(robot.sense(batch))
        yield from _rows(robot.flush())


def _rows(sensed: Iterable[tuple[Motions, Sweeps]]) -> Iterator[tuple[float, Scan, Array]]:
    for _, sweeps in sensed:
        for row in range(len(sweeps)):
            scan = sweeps.scan(row)
            if scan is not None:
                yield float(sweeps.columns.stamps[row]), scan, sweeps.T_middle_stamp[row]
