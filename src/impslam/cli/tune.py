"""`imp tune`: parameters from runs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Base, Common, Jobs, Output, Settings
from impslam.cli.sweep import Files, Scheduler, find_logs, make_pool
from impslam.errors import ConfigError
from impslam.paths import make_folder

if TYPE_CHECKING:
    from impslam.sweeps.cases import Case
    from impslam.sweeps.pool import Pool
    from impslam.sweeps.space import Space
    from impslam.sweeps.task import Task

TUNED, PICTURE = "tuned.toml", "search.png"
Score = Literal["best", "truth", "relations", "quality", "likelihood"]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Search:
    """What is searched, and what is good.

    Parameters
    ----------
    search
        A parameter and where to search: --search association.gate=0.9,0.99,0.999 or
        --search odometry.noise.forward=0.01:0.3. Default: all noise of odometry and sensors,
        from a tenth to ten times its value in the config.
    score
        Errors against the truth or relations, disagreement of the scans (quality), or the likelihood
        of the innovations, which finds noise. best: the first of truth, relations and quality that is
        available.
    holdout
        Held-out logs: the result is scored on them, but the search does not use them.
    trials
        Number of settings to try, including those of earlier calls with the same -o.
    seeds
        Seeds 0, 1, ... of each run.
    """

    search: Files = ()
    score: Score = "best"
    holdout: Files = ()
    trials: int = 50
    seeds: int = 1


def tune(  # noqa: PLR0913  # each is an option that a user may give
    *logs: str,
    config: Base = None,
    settings: Settings = (),
    search: Search | None = None,
    truth: Files = (),
    relations: Files = (),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    output: Output = None,
    common: Common | None = None,
) -> None:
    """Find noise and gates by many runs, and write a config with the evidence.

    The folder holds tuned.toml, search.png, the runs before and after (runs.csv, errors.png) and
    study.journal, with which the search goes on.

    Parameters
    ----------
    logs
        Logs to search on, or worlds (arena, room, ..., or a TOML file).
    truth
        The true path of a log, as a TUM file: --truth FILE, or LOG=FILE where there are several logs.
    relations
        A relation file of the SLAM benchmarking suite: --relations FILE, or LOG=FILE.
    output
        The folder to write to, or that of a search to continue. Default: runs/tune-DATE-TIME.
    """
    from impslam.sweeps.task import Task

    search, quiet = search or Search(), common is not None and common.quiet
    if search.trials < 1 or search.seeds < 1:
        raise ConfigError("--trials and --seeds: must be at least 1")
    shown = find_logs(logs and [*logs, *search.holdout], truth, relations)
    kept = [log for log in shown if log.name in search.holdout]
    task = Task([log for log in shown if log not in kept], kept, config, settings, search.seeds)
    space, pool = task.space(search.search), make_pool(jobs, scheduler)
    folder = output or make_folder(Path("runs"), f"tune-{time.strftime('%Y%m%d-%H%M%S')}")
    study = _search(task, space, search, pool, folder, quiet)
    _finish(task, space, study, search.score, pool, folder, quiet)


def _search(task: Task, space: Space, search: Search, pool: Pool, folder: Path, quiet: bool) -> Any:
    """Try settings; return the study."""
    from impslam.cli.interruption import Interruption
    from impslam.cli.progress import StageBars, display
    from impslam.sweeps.tuning import open_study, suggest
    from impslam.sweeps.tuning import search as find

    study = open_study(folder, task.values(space), space)
    with Interruption(), display(quiet) as shown:
        bars = StageBars(shown, "tune")

        def cases(trial: Any) -> list[Case]:
            return task.cases(suggest(space, trial))

        find(study, cases, search.score, pool, search.trials, bars)
    return study


def _finish(
    task: Task, space: Space, study: Any, score: Score, pool: Pool, folder: Path, quiet: bool
) -> None:
    """Run all logs, held-out ones included, with the old and the new config; write the result."""
    from impslam.cli.sweep import show_errors, write
    from impslam.sweeps.tuned import tuned_config
    from impslam.sweeps.tuning import best, suggest
    from impslam.sweeps.tuning_plot import draw_search

    found = suggest(space, best(study))
    rows = task.compare(found, pool)
    text = tuned_config(task, found, rows, score, study)
    (folder / TUNED).write_text(text, encoding="utf-8")
    draw_search(study, list(space)).savefig(folder / PICTURE, metadata={"Software": None})
    write(folder, rows)
    if not quiet:
        show_errors(rows)
        for line in text.splitlines():
            console.say(line)
        console.say(f"config: {folder / TUNED}")
