"""A run from a log to its folder: what `imp run` and `imp demo` have in common."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from impslam.cli.bar import Bar
from impslam.cli.progress import display
from impslam.config import Config
from impslam.errors import ConfigError, ImpError
from impslam.evaluation.landmark_files import landmarks_path, read_true_landmarks
from impslam.map import Map
from impslam.observers.base import Observer
from impslam.observers.recorder import Recorder
from impslam.paths import make_folder
from impslam.run import map_log
from impslam.sources.base import Source
from impslam.types import TrueLandmark

FILES = frozenset(
    {"trajectory.tum", "odometry.tum", "trajectory.csv", "landmarks.csv", "map.pgm", "map.yaml"}
    | {"map.imp", "graph.g2o", "trajectory.live.tum"}
    | {"report.html", "report.png", "summary.json", "config.toml", "truth.tum"}
    | {"truth.landmarks.csv"}
)
"""What a run writes; only these are ever overwritten or removed."""


def topic_settings(topics: Sequence[str]) -> list[str]:
    """Turn "scan=/front/scan" into the setting that it abbreviates."""
    for topic in topics:
        role, equals, name = topic.partition("=")
        if not (role and equals and name):
            raise ConfigError(f"--topic {topic}: expected role=name, e.g. --topic scan=/scan")
    return [f"source.topics.{topic}" for topic in topics]


def execute(
    config: Config,
    source: Source,
    folder: Path,
    quiet: bool,
    more: Iterable[Observer] = (),
    known: Sequence[TrueLandmark] = (),
    player: Callable[[Config, Source, list[Observer]], Map] = map_log,
) -> Map:
    """Run a log, write the run folder, and show how far it has come.

    `known` are the true landmarks, for scoring alone, where neither the source nor a file beside it
    tells them. `player` takes the log through the estimator: at once, or on a page.
    """
    if folder.resolve().is_relative_to(source.path.resolve()):
        raise ConfigError(f"{folder}: is inside the log and would change it; give another -o")
    empty = not folder.exists() or not any(folder.iterdir())
    _clear(folder)
    try:
        with display(quiet) as shown:
            known = known or source.true_landmarks() or _surveyed(source.path)
            return player(config, source, [Bar(source, shown), Recorder(folder, known), *more])
    except ImpError:
        _clear(folder)
        if empty and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise


def _surveyed(log: Path) -> list[TrueLandmark]:
    """Return the true landmarks that lie beside a log."""
    path = landmarks_path(log)
    return read_true_landmarks(path) if path.is_file() else []


def _clear(folder: Path) -> None:
    """Remove what a run has written, so that no folder holds parts of two runs."""
    for name in FILES:
        (folder / name).unlink(missing_ok=True)


def run_folder(wanted: Path | None, name: str, also: Iterable[str] = ()) -> Path:
    """Return the folder to write to: the one asked for, or a new one under runs/.

    An existing folder is used again if it is empty or holds nothing but a run (and `also`).

    Raises
    ------
    ConfigError
        If the path is a file, or a folder that holds anything else.
    """
    if wanted is None:
        return make_folder(Path("runs"), f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    if wanted.exists() and not wanted.is_dir():
        raise ConfigError(f"{wanted}: is a file; give -o a folder")
    strange = {p.name for p in wanted.iterdir()} - FILES - set(also) if wanted.exists() else set()
    if strange and not (wanted / "trajectory.tum").exists():
        raise ConfigError(
            f"{wanted}: is not the folder of a run (it contains {min(strange)!r}); "
            "give -o a new or an empty one"
        )
    return wanted
