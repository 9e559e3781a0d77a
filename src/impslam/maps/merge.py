"""Merge maps of one building, from any number of robots.

Each map is aligned with those merged so far (see `relation`) and joined to their pose graph by the
recognised places (see `joining`); then further closures are searched along it. After that, all keyframes
are refined jointly, and landmarks are estimated again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

from impslam.config import Config, load
from impslam.continuing import logs_of, mapped_logs, same_scans
from impslam.errors import ConfigError, ImpError
from impslam.estimators.graph import Graph
from impslam.map import Map, check_map
from impslam.map_builder import blended
from impslam.maps.joining import joined
from impslam.maps.relation import MapRelation, RelationStatus, align_maps
from impslam.provenance import versions

Progress = Callable[[str, float], None]
"""Called with the current task, and its completed share, 0 to 1."""


class NotMergedError(ImpError):
    """The relative pose of a map and the others could not be determined.

    Attributes
    ----------
    which : number of the map, from 0
    found : the result of the alignment
    """

    def __init__(self, which: int, found: MapRelation) -> None:
        super().__init__(
            f"map {which + 1}: {found.words}; drive in an area that the other maps contain"
        )
        self.which, self.found = which, found


def merged(first: Map, *others: Map, progress: Progress = lambda what, share: None) -> Map:
    """Return the merged map, in the frame of the first.

    Raises
    ------
    NotMergedError
        If the relative pose of one of them cannot be determined.
    ConfigError
        If one of them is not a `Map`, such as the path of its file, or two contain the same log.

    Examples
    --------
    Two robots have driven through one room, the second one the other way round:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import impslam
    >>> from impslam.maps.merge import merged
    >>> from impslam.simulation.robot import SimulatedRobot
    >>> from impslam.simulation.simulate import simulate
    >>> from impslam.simulation.world import load_world
    >>> from impslam.sources.recording import McapWriter
    >>> maps = []
    >>> for seed in (1, 2):
    ...     log = Path(tempfile.mkdtemp()) / "room.mcap"
    ...     with McapWriter(log) as writer:
    ...         for message in simulate(load_world("room"), SimulatedRobot(imu=None), seed=seed):
    ...             writer.write(message)
    ...     maps.append(impslam.run(log, "imp", ["estimator.kind=graph"]))
    >>> both = merged(*maps)
    >>> len(both.stamps) == len(maps[0].stamps) + len(maps[1].stamps)
    True
    """
    for which, one in enumerate((first, *others), 1):
        check_map(f"map {which}", one)
    check_logs((first, *others), [f"map {which}" for which in range(1, len(others) + 2)])
    config = load("default")
    known, waiting = _with_graph(first, config), dict(enumerate(others, 1))
    while waiting:
        which, found = _next(known, waiting, progress)
        other = _with_graph(waiting.pop(which), config).moved(found.T)
        progress("joining", 1.0 - len(waiting) / len(others))
        both = replace(joined(known, other, found.links), about=_about(known, other))
        known = _refined(both, len(known.keyframes), config)
    return known


def check_logs(maps: Sequence[Map], names: Sequence[str]) -> None:
    """Check that no log is in two of the maps: its scans would count twice.

    Logs are identified by their hash; the maps of robots and of `Slam`, which have none, by the stamps and
    the odometry of their scans.

    Raises
    ------
    ConfigError
        If one is; the message has the names of both maps and of the log.
    """
    owners: dict[str, str] = {}
    for known, name in zip(maps, names, strict=True):
        logs = mapped_logs(logs_of(known))
        for sha256, log in logs.items():
            if sha256 in owners:
                raise ConfigError(
                    f"{owners[sha256]} and {name} both contain the log {log['log']}, whose scans would "
                    "count twice; merge maps of different logs"
                )
        owners |= dict.fromkeys(logs, name)
    for (known, name), (other, other_name) in combinations(zip(maps, names, strict=True), 2):
        if count := same_scans(known, other):
            raise ConfigError(
                f"{name} and {other_name} both contain the same {count} scans, which would count twice; "
                "merge maps of different drives"
            )


def _about(first: Map, second: Map) -> dict[str, Any]:
    """Return the origin of a merged map: all logs, and the config of the first."""
    names = ("log", "log_sha256", "config")
    named = {name: first.about[name] for name in names if name in first.about}
    return {**named, "logs": [*logs_of(first), *logs_of(second)], "versions": versions()}


def _next(known: Map, waiting: dict[int, Map], progress: Progress) -> tuple[int, MapRelation]:
    """Return the first map that can be aligned with those merged so far, and its alignment."""
    failed: dict[int, MapRelation] = {}
    for which, other in waiting.items():
        step = partial(progress, f"finding map {which + 1}")
        found = align_maps(known.keyframes, other.keyframes, step)
        if found.outcome is RelationStatus.FOUND:
            return which, found
        failed[which] = found
    raise NotMergedError(*next(iter(failed.items())))


def _graph(known: Map, config: Config) -> Graph:
    estimator = config.make_estimator(known)
    assert isinstance(estimator, Graph), "the default estimator is a graph"
    return estimator


def _with_graph(known: Map, config: Config) -> Map:
    """Return the map, with the motions between its keyframes as a graph if it has none."""
    return known if len(known.edges.i) else replace(known, edges=_graph(known, config).edges())


def _refined(known: Map, begin: int, config: Config) -> Map:
    """Return a joined map after a search for closures from keyframe `begin` on, and refinement."""
    graph = _graph(known, config)
    graph.search_loops(begin)
    revision = graph.refine()
    assert revision is not None, "there are keyframes"
    refined = blended(replace(known, edges=graph.edges()).revised(revision))
    return replace(refined, landmarks=graph.landmarks())
