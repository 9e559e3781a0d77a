"""A run from a log to its files: what `imp run` and `imp demo` have in common."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from impslam.cli.bar import Bar
from impslam.cli.exports import Exports
from impslam.cli.interruption import Interruption
from impslam.cli.progress import display
from impslam.config import Config
from impslam.continuing import Known
from impslam.errors import ConfigError
from impslam.evaluation.landmark_files import read_surveyed
from impslam.health import SOUND, Standing
from impslam.map import Map
from impslam.observers.base import Observer
from impslam.observers.recorder import Recorder
from impslam.run import map_log
from impslam.sources.base import Source
from impslam.types import TrueLandmark


def settings_of(
    settings: Sequence[str],
    topics: Sequence[str] = (),
    columns: Sequence[str] = (),
    seed: int | None = None,
) -> list[str]:
    """Return the settings, with those that other options abbreviate."""
    seeds = [] if seed is None else [f"seed={seed}"]
    return [*settings, *topic_settings(topics), *column_settings(columns), *seeds]


def topic_settings(topics: Sequence[str]) -> list[str]:
    """Turn "scan=/front/scan" into the setting that it abbreviates."""
    for topic in topics:
        role, equals, name = topic.partition("=")
        if not (role and equals and name):
            raise ConfigError(f"--topic {topic}: expected role=name, e.g. --topic scan=/scan")
    return [f"source.topics.{topic}" for topic in topics]


def column_settings(columns: Sequence[str]) -> list[str]:
    """Turn "stamp=t,ranges=r0:r359" into the settings that it abbreviates."""
    pairs = [one.partition("=") for text in columns for one in text.split(",")]
    for role, equals, name in pairs:
        if not (role.strip() and equals and name.strip()):
            raise ConfigError(
                f"--columns {role + equals + name}: expected role=column, e.g. --columns stamp=t"
            )
    return [f"source.columns.{role.strip()}={json.dumps(name.strip())}" for role, _, name in pairs]


def execute(  # noqa: PLR0913  # all that a run consists of
    config: Config,
    source: Source,
    folder: Path,
    quiet: bool,
    *,
    more: Iterable[Observer] = (),
    known: Sequence[TrueLandmark] = (),
    player: Callable[[Config, Source, list[Observer], Standing], Map] | None = None,
    begin: Known | None = None,
    exports: Exports | None = None,
    health: Standing = SOUND,
) -> Map:
    """Run a log, write its files into a folder, and show how far it has come.

    A run that an error or a signal ends early writes what it knows, marked as partial. `known` are the
    true landmarks, for scoring alone, where neither the source nor a file beside it tells them.
    `begin` is a map to continue, `exports` lists what else to write at the end, `health` what is wrong
    with the log throughout. `player` takes the log
    through the estimator in another way than at once.
    """
    if folder.resolve().is_relative_to(source.path.resolve()):
        raise ConfigError(f"{folder}: is inside the log and would change it; give another -o")
    with display(quiet) as shown:
        known = known or source.true_landmarks() or read_surveyed(source.path)
        bar = Bar(source, shown)
        files = [] if exports is None else exports.observers(bar.show)
        observers = [bar, Recorder(folder, known), *more, *files]
        if player is not None:
            return player(config, source, observers, health)
        with Interruption(bar.interrupted) as interruption:
            seen = [*observers, interruption]
            return map_log(config, source, seen, interruption.check, begin, health)
