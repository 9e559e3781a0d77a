"""`imp run`: map a log."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Base, Columns, Common, Flag, Force, Output, Seed, Settings, Topics
from impslam.cli.exports import Exports
from impslam.errors import ConfigError

if TYPE_CHECKING:
    from impslam.config import Config
    from impslam.continuing import Known
    from impslam.health import Standing
    from impslam.map import Map
    from impslam.observers.base import Outcome
    from impslam.sources.base import Source


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Page:
    """Options of the live page.

    Parameters
    ----------
    live
        Replay the log on a web page at the speed of its stamps, with pause, step and speed control.
    port
        TCP port of the page.
    """

    live: Flag = False
    port: int = 8080


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Begin:
    """Options of a run that continues a map.

    Parameters
    ----------
    map
        Continue this map (map.imp; with --frozen also a grid, map.yaml). The place where the log begins
        is found; a log that was stopped in the middle continues where the map ends.
    frozen
        Localise in the map without changing it.
    start
        Roughly where in the map the log begins: x,y or x,y,theta in m and rad. Default: it is found.
    """

    map: Path | None = None
    frozen: Flag = False
    start: str | None = None

    def known(self, *, live: bool) -> Known | None:
        """Return the map to continue, or None; raise `ConfigError` for a run that is `live`."""
        from impslam.continuing import begin_with

        if self.map is not None and live:
            raise ConfigError("--live shows a log from its start; leave out --live or --map")
        hint = None if self.start is None else place(self.start)
        if self.map is None and (self.frozen or hint is not None):
            raise ConfigError("--frozen and --start need a map; give one with --map FILE")
        return begin_with(self.map, frozen=self.frozen, hint=hint)


def place(text: str) -> list[float]:
    """Return the numbers of "x,y" or "x,y,theta"."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {2, 3} or not all(map(math.isfinite, numbers)):
        raise ConfigError(f"--start {text}: is no place; give x,y in m, or x,y,theta with rad")
    return numbers


def run(  # noqa: PLR0913  # each is an option that a user may give
    log: Path,
    /,
    *,
    config: Base = None,
    output: Output = None,
    settings: Settings = (),
    topics: Topics = (),
    columns: Columns = (),
    seed: Seed = None,
    force: Force = False,
    begin: Begin | None = None,
    page: Page | None = None,
    exports: Exports | None = None,
    common: Common | None = None,
) -> None:
    """Map a log: write its path, landmarks, grid and report into a folder.

    Parameters
    ----------
    log
        A file or folder; its format is recognised from its content.
    output
        A new folder to write to. Default: runs/LOG-DATE-TIME.
    """
    from impslam.cli.job import execute, settings_of
    from impslam.cli.replay import replay
    from impslam.cli.run_folder import run_folder
    from impslam.observers.ending import EndOfRun
    from impslam.open_log import open_log

    changes, page, end = settings_of(settings, topics, columns, seed), page or Page(), EndOfRun()
    quiet = common is not None and common.quiet
    known_map = None if begin is None else begin.known(live=page.live)
    chosen, source = open_log(log, config, changes)
    if known_map is not None:
        chosen = _going_on(chosen, changes, quiet=quiet)
    player = partial(replay, port=page.port, quiet=quiet) if page.live else None
    with run_folder(output, log.resolve().name.split(".")[0] or "log", force=force) as folder:
        health = _first_look(chosen, source, config, quiet=quiet)
        known = execute(
            chosen, source, folder, quiet or page.live,
            more=[end], player=player, begin=known_map, exports=exports, health=health,
        )  # fmt: skip
    if not quiet and end.outcome is not None:
        show(known, end.outcome, output or folder, at_once=not page.live)
        for line in () if exports is None else exports.lines():
            console.say(line)


def _first_look(config: Config, source: Source, preset: str | None, *, quiet: bool) -> Standing:
    """Return what the first look says of all poses; print what it finds unless `quiet`."""
    from impslam.cli.first_look import show_first_look
    from impslam.diagnosis.diagnose import first_health

    return first_health(config, source) if quiet else show_first_look(config, source, preset)


def _going_on(config: Config, changes: list[str], *, quiet: bool) -> Config:
    """Return the config with an estimator that can continue a map; print it if it was replaced."""
    from impslam.open_log import for_continuing

    able = for_continuing(config, changes)
    if able is not config and not quiet:
        console.say(f"estimator: graph, because {config.estimator['kind']} cannot continue a map")
    return able


def show(known: Map, outcome: Outcome, folder: Path, *, at_once: bool = True) -> None:
    """Print the results of a run; `at_once` if it was not replayed, so that its speed is meaningful."""
    from impslam.observers.summary import compiled, length, loops, real_time_factor

    counts, seconds = outcome.counts, outcome.log_seconds
    kinds = Counter(landmark.kind for landmark in known.landmarks)
    found = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "none"
    closed = loops(counts)
    before = len(known.stamps) - len(outcome.health.stamps)  # sweeps of the map that was continued
    way = length(known, known.path(), before)
    console.show_facts(
        {
            "log": str(outcome.log),
            **({"odometry": "none, mapped by the lidar alone"} if outcome.lidar_alone else {}),
            "scans": f"{counts['steps']} used",
            "path": f"{way:.2f} m in {seconds:.1f} s",
            "landmarks": found,
            **({"loops": closed} if closed else {}),
            "time": f"{outcome.wall_seconds:.1f} s"
            + (f" ({compiled(outcome)}, once)" if compiled(outcome) else "")
            + (f", {real_time_factor(outcome):.0f} times real time" if at_once else ""),
        }
    )
    for kind, dropped in outcome.dropped.items():
        console.show_problem(kind, dropped.count, dropped.example)
    console.say(f"pose: {outcome.health.summary}")
    console.say(f"report: {folder / 'report.html'}")
