"""`imp tune`: tune parameters over many runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Common, ConfigName, Jobs, Output, Settings, Whole
from impslam.cli.run_folder import default_folder
from impslam.cli.sweep import Files, Scheduler, find_logs, make_pool
from impslam.errors import ConfigError
from impslam.paths import exclusive

if TYPE_CHECKING:
    from impslam.sweeps.cases import Case
    from impslam.sweeps.pool import Pool
    from impslam.sweeps.space import Space
    from impslam.sweeps.task import Task

CONFIG, PICTURE = "tuned.toml", "search.png"
Score = Literal["best", "truth", "relations", "quality", "likelihood"]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Search:
    """The search space and the score.

    Parameters
    ----------
    search
        A parameter with its values or its range: --search association.gate=0.9,0.99,0.999 or
        --search odometry.noise.forward=0.01:0.3. Default: all noise of odometry and sensors, from a
        tenth to ten times the value in the config.
    score
        truth or relations: the error against them. quality: the disagreement of the scans.
        likelihood: the negative log-likelihood of the innovations, for noise parameters. best: the
        first available of truth, relations and quality.
    holdout
        Held-out logs: the result is scored on them, but the search does not use them.
    trials
        Number of settings to try, including those of earlier calls with the same -o.
    seeds
        Number of seeds (0, 1, ...) of each run.
    """

    search: Files = ()
    score: Score = "best"
    holdout: Files = ()
    trials: Whole = 50
    seeds: Whole = 1


def tune(  # noqa: PLR0913  # each is an option that a user may give
    *logs: str,
    config: ConfigName = None,
    settings: Settings = (),
    search: Search | None = None,
    truth: Files = (),
    relations: Files = (),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    output: Output = None,
    common: Common | None = None,
) -> None:
    """Tune noise and gates over many runs and write a config with the evidence.

    The folder contains tuned.toml, search.png, the runs before and after (runs.csv, errors.png) and
    study.journal, from which the search can be continued.

    Parameters
    ----------
    logs
        Logs to tune on, or worlds to simulate (arena, room, ..., or a TOML file).
    truth
        TUM file of a log's true path: --truth FILE, or LOG=FILE if there are several logs.
    relations
        Relation file of the SLAM benchmarking suite: --relations FILE, or LOG=FILE.
    output
        Folder for the results, or that of a search to continue. Default: runs/tune-DATE-TIME.
    """
    from impslam.sweeps.task import Task

    search, quiet = search or Search(), common is not None and common.quiet
    if search.trials < 1 or search.seeds < 1:
        raise ConfigError("--trials and --seeds: must be at least 1")
    if both := sorted(set(logs) & set(search.holdout)):
        raise ConfigError(f"{both[0]}: named as a log to tune on and with --holdout; name it once")
    all_logs = find_logs(logs and [*logs, *search.holdout], truth, relations)
    held_out = [log for log in all_logs if log.name in search.holdout]
    tuned_on = [log for log in all_logs if log not in held_out]
    task = Task(tuned_on, held_out, config, settings, search.seeds)
    space, pool = task.space(search.search), make_pool(jobs, scheduler)
    folder = output or default_folder("tune")
    with exclusive(folder):
        study = _search(task, space, search, pool, folder, quiet)
        _finish(task, space, study, search.score, pool, folder, quiet)


def _search(task: Task, space: Space, search: Search, pool: Pool, folder: Path, quiet: bool) -> Any:
    """Search the space; return the study."""
    from impslam.cli.progress import StageBars, display
    from impslam.sweeps.tuning import open_study, suggest
    from impslam.sweeps.tuning import search as find

    study = open_study(folder, task.values(space), space, task.evidence(search.score))
    with display(quiet) as progress:
        bars = StageBars(progress, "tune")

        def cases(trial: Any) -> list[Case]:
            return task.cases(suggest(space, trial))

        find(study, cases, search.score, pool, search.trials, bars)
    return study


def _finish(
    task: Task, space: Space, study: Any, score: Score, pool: Pool, folder: Path, quiet: bool
) -> None:
    """Run all logs, including held-out ones, with the old and new configs; write the results."""
    from impslam.cli.sweep import show_errors, write
    from impslam.evaluation.plots import as_png
    from impslam.paths import write_bytes
    from impslam.sweeps.tuned import tuned_config
    from impslam.sweeps.tuning import best, suggest
    from impslam.sweeps.tuning_plot import draw_search

    found = suggest(space, best(study))
    rows = task.compare(found, pool)
    text = tuned_config(task, found, rows, score, study, folder)
    write_bytes(folder / CONFIG, text.encode())
    write_bytes(folder / PICTURE, as_png(draw_search(study, list(space))))
    write(folder, rows)
    if not quiet:
        show_errors(rows)
        for line in text.splitlines():
            console.echo(line)
        console.echo(f"config: {folder / CONFIG}")
