"""A run from a log to its files, shared by `imp run` and `imp demo`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

from impslam.cli.bar import RunBar
from impslam.cli.exports import Exports
from impslam.cli.interruption import Interruption
from impslam.cli.progress import display
from impslam.config import Config
from impslam.continuing import KnownMap
from impslam.errors import ConfigError
from impslam.evaluation.landmark_files import read_surveyed
from impslam.health import NO_FAULT, LogFault
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer
from impslam.observers.recorder import Recorder
from impslam.paths import keep_inputs
from impslam.run import map_log
from impslam.sources.base import Source
from impslam.types import TrueLandmark

Player: TypeAlias = Callable[[Config, Source, list[Observer], LogFault], Map]
"""Runs a log through the estimator for some observers, e.g. in real time."""


def all_settings(
    settings: Sequence[str],
    topics: Sequence[str] = (),
    columns: Sequence[str] = (),
    seed: int | None = None,
) -> list[str]:
    """Return the settings, including those given by shorthand options."""
    seeds = [] if seed is None else [f"seed={seed}"]
    return [*settings, *topic_settings(topics), *column_settings(columns), *seeds]


def topic_settings(topics: Sequence[str]) -> list[str]:
    """Expand "scan=/front/scan" to a setting."""
    for topic in topics:
        role, equals, name = topic.partition("=")
        if not (role and equals and name):
            raise ConfigError(f"--topic {topic}: expected role=name, e.g. --topic scan=/scan")
    return [f"source.topics.{topic}" for topic in topics]


def column_settings(columns: Sequence[str]) -> list[str]:
    """Expand "stamp=t,ranges=r0:r359" to settings."""
    pairs = [one.partition("=") for text in columns for one in text.split(",")]
    for role, equals, name in pairs:
        if not (role.strip() and equals and name.strip()):
            raise ConfigError(
                f"--columns {role + equals + name}: expected role=column, e.g. --columns stamp=t"
            )
    return [f"source.columns.{role.strip()}={json.dumps(name.strip())}" for role, _, name in pairs]


def execute(  # noqa: PLR0913  # all parts of a run
    config: Config,
    source: Source,
    folder: Path,
    quiet: bool,
    *,
    more: Iterable[Observer] = (),
    true_landmarks: Sequence[TrueLandmark] = (),
    player: Player | None = None,
    known_map: KnownMap | None = None,
    exports: Exports | None = None,
    fault: LogFault = NO_FAULT,
    interruption: Interruption | None = None,
) -> Map:
    """Map a log, write the results to a folder, and show the progress.

    If an error or a signal ends the run early, what has been mapped is written and marked as partial.

    Parameters
    ----------
    true_landmarks : for scoring only; used instead of those of the source or the file beside it
    player : runs the log through the estimator, e.g. in real time; default: as fast as possible
    known_map : the map to continue
    exports : further files to write
    fault : of the whole log, which affects all poses
    interruption : stops the run between two scans; default: nothing does
    """
    keep_inputs([source.path], [folder, *([] if exports is None else exports.files())])
    with display(quiet) as progress:
        landmarks = true_landmarks or source.true_landmarks() or read_surveyed(source.path)
        bar = RunBar(source, progress)
        files = [] if exports is None else list(exports.observers(bar.show))
        observers = [bar, Recorder(folder, landmarks), *more, *files]
        stop = interruption or Interruption()
        stop.check()
        if player is not None:
            return player(config, source, observers, fault)
        stop.on_stop = bar.interrupted
        observers.append(StopBetweenScans(stop))
        return map_log(config, source, observers, stop.check, known_map, fault)


class StopBetweenScans(Observer):
    """Stops a run after a scan if a signal was received."""

    def __init__(self, interruption: Interruption) -> None:
        self._interruption = interruption

    def follow(self, track: Track, path: PathRows) -> None:
        """Stop the run if a signal was received."""
        del track, path
        self._interruption.check()

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Stop the run if a signal was received."""
        del keyframe, revision, path
        self._interruption.check()
