"""`imp run`: map a log."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import (
    Columns,
    Common,
    ConfigName,
    Flag,
    Force,
    Output,
    Seed,
    Settings,
    Topics,
    whole_number,
)
from impslam.cli.exports import Exports
from impslam.cli.interruption import Interruption
from impslam.errors import ConfigError

if TYPE_CHECKING:
    from impslam.cli.job import Player
    from impslam.config import Config
    from impslam.continuing import KnownMap
    from impslam.health import LogFault
    from impslam.map import Map
    from impslam.observers.base import Outcome
    from impslam.sources.base import Source


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class LivePage:
    """Options of the live page.

    Parameters
    ----------
    live
        Replay the log in real time on a web page, with pause, step and speed control.
    port
        TCP port of the page of --live. Default: 8080.
    """

    live: Flag = False
    port: Annotated[int | None, Parameter(converter=whole_number)] = None

    def player(self, *, quiet: bool) -> Player | None:
        """Return what replays the log on the page; None without --live.

        Raises
        ------
        ConfigError
            If there is a port, but no page.
        """
        from impslam.cli.replay import replay

        if self.live:
            return partial(replay, port=8080 if self.port is None else self.port, quiet=quiet)
        if self.port is not None:
            raise ConfigError("--port is that of the live page; add --live")
        return None


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ContinuationOptions:
    """Options of a run that continues a map.

    Parameters
    ----------
    map
        Continue this map (map.imp; with --frozen also a grid, map.yaml). The log's start is located in
        the map. If a run of this log was interrupted, its scans in the map are tracked again, and the rest
        is mapped.
    frozen
        Localise in the map without changing it.
    start
        Approximate start of the log in the map: x,y or x,y,theta in m and rad. Default: search for it.
    """

    map: Path | None = None
    frozen: Flag = False
    start: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None  # -1,2

    def known(self, *, live: bool, outputs: Sequence[Path]) -> KnownMap | None:
        """Return the map to continue, or None.

        Raises
        ------
        ConfigError
            If the run is `live`, or one of its output files would replace the map.
        """
        from impslam.continuing import begin_with
        from impslam.paths import keep_inputs

        keep_inputs([self.map], outputs)
        if self.map is not None and live:
            raise ConfigError("--live cannot continue a map; leave out --live or --map")
        hint = None if self.start is None else parse_start(self.start)
        if self.map is None and (self.frozen or hint is not None):
            raise ConfigError("--frozen and --start need a map; give one with --map FILE")
        return begin_with(self.map, frozen=self.frozen, hint=hint)


def parse_start(text: str) -> list[float]:
    """Return the numbers in "x,y" or "x,y,theta"."""
    from impslam.parameters import SIZES

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {2, 3} or not all(map(math.isfinite, numbers)):
        raise ConfigError(f"--start {text}: not a pose; give x,y or x,y,theta in m and rad")
    if any(abs(theta) > SIZES["rad"][1] for theta in numbers[2:]):
        raise ConfigError(f"--start {text}: theta is in rad; 180 deg is 3.1416")
    return numbers


def run(  # noqa: PLR0913  # each is an option that a user may give
    log: Path,
    /,
    *,
    config: ConfigName = None,
    output: Output = None,
    settings: Settings = (),
    topics: Topics = (),
    columns: Columns = (),
    seed: Seed = None,
    force: Force = False,
    continuation: ContinuationOptions | None = None,
    page: LivePage | None = None,
    exports: Exports | None = None,
    common: Common | None = None,
) -> None:
    """Map a log and write the path, landmarks, grid and report to a folder.

    Parameters
    ----------
    log
        A file or folder; its format is detected from its content.
    output
        New folder for the results. Default: runs/LOG-DATE-TIME.
    """
    with Interruption() as interruption:
        from impslam.cli.job import all_settings, execute
        from impslam.cli.run_folder import log_stem, run_folder
        from impslam.observers.ending import EndOfRun
        from impslam.open_log import open_log

        interruption.check()
        changes = all_settings(settings, topics, columns, seed)
        page, end, quiet = page or LivePage(), EndOfRun(), common is not None and common.quiet
        player = page.player(quiet=quiet)
        exports, continuation = exports or Exports(), continuation or ContinuationOptions()
        known_map = continuation.known(live=page.live, outputs=exports.checked().files())
        chosen, source = open_log(log, config, changes)
        interruption.check()
        chosen = chosen if known_map is None else _continuing_config(chosen, changes, quiet=quiet)
        with run_folder(output, log_stem(source.path), force=force) as folder:
            known = execute(
                chosen, source, folder, quiet or page.live,
                more=[end], known_map=known_map, exports=exports, interruption=interruption,
                player=player,
                fault=_log_fault(chosen, source, config, quiet=quiet),
            )  # fmt: skip
        if not quiet and end.outcome is not None:
            show_result(known, end.outcome, output or folder, with_speed=not page.live)
            console.echo(*exports.lines())


def _log_fault(config: Config, source: Source, preset: str | None, *, quiet: bool) -> LogFault:
    """Return the fault that affects all poses, by the initial findings; print them unless `quiet`."""
    from impslam.cli.initial_findings import show_initial_findings
    from impslam.diagnosis.diagnose import find_log_fault

    return (
        find_log_fault(config, source) if quiet else show_initial_findings(config, source, preset)
    )


def _continuing_config(config: Config, changes: list[str], *, quiet: bool) -> Config:
    """Return the config with an estimator that can continue a map; report a replacement."""
    from impslam.open_log import for_continuing

    able = for_continuing(config, changes)
    if able is not config and not quiet:
        console.echo(f"estimator: graph, because {config.estimator['kind']} cannot continue a map")
    return able


def _duration(seconds: float) -> str:
    known = math.isfinite(seconds)
    return f"{seconds:.1f} s" if known else "an unknown time: its stamps are unusable"


def show_result(known: Map, outcome: Outcome, folder: Path, *, with_speed: bool = True) -> None:
    """Print the results of a run; `with_speed` prints its speed, meaningless after a live replay."""
    from impslam.observers.summary import compiled, kinds, length, loops, real_time_factor

    counts, seconds, factor = outcome.counts, outcome.log_seconds, real_time_factor(outcome)
    found = kinds(Counter(landmark.kind for landmark in known.landmarks)) or "none"
    closed = loops(counts)
    before = len(known.stamps) - len(outcome.health.stamps)  # sweeps of the continued map
    travel = length(known, known.path(), before)
    console.show_facts(
        {
            "log": str(outcome.log),
            **({"odometry": "none, mapped by the lidar alone"} if outcome.lidar_alone else {}),
            "scans": f"{counts['steps']} used",
            "path": f"{travel:.2f} m in {_duration(seconds)}",
            "landmarks": found,
            **({"loops": closed} if closed else {}),
            "time": f"{outcome.wall_seconds:.1f} s"
            + (f" ({compiled(outcome)}, once)" if compiled(outcome) else "")
            + (f", {factor:.0f} times real time" if with_speed and math.isfinite(factor) else ""),
        }
    )
    for kind, dropped in outcome.dropped.items():
        console.show_problem(kind, dropped.count, dropped.example)
    console.echo(f"pose: {outcome.health.summary}")
    if outcome.health.needs_inspection:
        console.echo(
            f"fix: imp inspect {shlex.quote(str(outcome.log))} measures mounts, times and scales, and "
            "prints the settings that correct them"
        )
    console.echo(f"report: {folder / 'report.html'}")
