"""`imp sweep`: many runs, one table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Common, Jobs, Output, Repeatable, Whole
from impslam.cli.run_folder import default_folder
from impslam.errors import ConfigError
from impslam.paths import exclusive

if TYPE_CHECKING:
    from impslam.sweeps.cases import Case, Log
    from impslam.sweeps.journal import Journal
    from impslam.sweeps.pool import Pool
    from impslam.sweeps.rows import Row

PICTURE = "errors.png"
MAX_FAILURES_SHOWN = 5
"""Number of failed runs that are printed."""

Configs = Annotated[
    Repeatable,
    Parameter(
        name=["--config", "-c"],
        help="Presets or TOML files. Default: the preset that fits each log.",
    ),
]
Alternatives = Annotated[
    Repeatable,
    Parameter(
        name="--set",
        help="Values of a parameter to try: --set filter.kind=ekf,riekf. Repeat the option to try all "
        "combinations.",
    ),
]
Files = Repeatable
Scheduler = Annotated[
    str | None,
    Parameter(help="Run on a Dask cluster, given its scheduler's address: tcp://HOST:8786."),
]


def sweep(  # noqa: PLR0913  # each is an option that a user may give
    *logs: str,
    configs: Configs = (),
    settings: Alternatives = (),
    seeds: Whole = 1,
    truth: Files = (),
    relations: Files = (),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    output: Output = None,
    common: Common | None = None,
) -> None:
    """Map all combinations of logs, configs, settings and seeds, and write a table with a row per run.

    The folder contains runs.csv, runs.parquet, runs.jsonl (the rows in order of completion) and
    errors.png. Failed runs have a row, too. In the folder of an earlier sweep, only missing runs are run.

    Parameters
    ----------
    logs
        Logs, or worlds (arena, room, ..., or a TOML file) in which a drive is simulated for each seed.
    seeds
        Number of seeds (0, 1, ...) of each run.
    truth
        TUM file of a log's true path: --truth FILE, or LOG=FILE if there are several logs.
    relations
        Relation file of the SLAM benchmarking suite: --relations FILE, or LOG=FILE.
    output
        Folder for the results, or that of a sweep to continue. Default: runs/sweep-DATE-TIME.
    """
    from impslam.sweeps.cases import alternatives, cases
    from impslam.sweeps.journal import Journal

    quiet = common is not None and common.quiet
    found = find_logs(logs, truth, relations)
    if seeds < 1:
        raise ConfigError(f"--seeds {seeds}: must be at least 1")
    todo = cases(found, configs or (None,), alternatives(settings), seeds)
    pool = make_pool(jobs, scheduler)
    folder = output or default_folder("sweep")
    with exclusive(folder):
        journal = Journal(folder)
        remaining = [case for case in todo if not journal.has(case.row())]
        if not quiet and len(remaining) < len(todo):
            console.echo(f"{len(todo) - len(remaining)} of {len(todo)} runs are already done")
        try:
            _run(remaining, pool, journal, quiet)
        finally:
            files = write(folder, journal.rows()) if journal.rows() else []
    if not quiet:
        show_errors(journal.rows())
        console.echo(f"table: {', '.join(map(str, files))}")


def find_logs(
    names: Sequence[str], truth: Sequence[str] = (), relations: Sequence[str] = ()
) -> list[Log]:
    """Return the logs named on the command line, with the files to score them against."""
    from impslam.sweeps.cases import find_log

    if not names:
        raise ConfigError("no log given; name logs, or worlds such as arena")
    references = _by_log("--truth", truth, names), _by_log("--relations", relations, names)
    return [
        find_log(name, *(files.get(name) for files in references)) for name in dict.fromkeys(names)
    ]


def _by_log(option: str, files: Sequence[str], logs: Sequence[str]) -> dict[str, str]:
    """Return the file of each log from "FILE" or "LOG=FILE"; LOG is a log as given, or its file's stem."""
    found = {}
    for word in files:
        name, equals, file = word.rpartition("=")
        if not equals and len(logs) > 1:
            raise ConfigError(f"{option} {word}: does not name its log; write LOG={word}")
        matches = [log for log in logs if not equals or name in (log, Path(log).name.split(".")[0])]
        if len(matches) != 1:
            raise ConfigError(f"{option} {word}: {name} is not one of the logs {', '.join(logs)}")
        found[matches[0]] = file
    return found


def make_pool(jobs: int | None, scheduler: str | None) -> Pool:
    """Return the pool that the options --jobs and --scheduler ask for."""
    from impslam.sweeps.cluster import Cluster
    from impslam.sweeps.pool import Processes

    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs {jobs}: must be at least 1")
    if scheduler is not None and jobs is not None:
        raise ConfigError("--jobs and --scheduler: give only one; a cluster has its own workers")
    return Processes(jobs or os.cpu_count() or 1) if scheduler is None else Cluster(scheduler)


def _run(cases: Sequence[Case], pool: Pool, journal: Journal, quiet: bool) -> None:
    """Run cases and write their rows to the journal as they complete."""
    from impslam.cli.progress import StageBars, display
    from impslam.sweeps.measures import run_case
    from impslam.sweeps.pool import ProcessDied

    with display(quiet) as progress:
        bars = StageBars(progress, "sweep")
        bars("runs", 0, len(cases))
        for done, (index, result) in enumerate(pool.each(run_case, cases), start=1):
            run = cases[index].row()
            journal.add({**run, "error": result.why} if isinstance(result, ProcessDied) else result)
            bars("runs", done, len(cases))


def write(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """Write the table, and the picture if the errors of any run are known; return the files."""
    from impslam.evaluation.plots import as_png
    from impslam.paths import write_bytes
    from impslam.sweeps.plot import draw_sweep
    from impslam.sweeps.table import write_table
    from impslam.sweeps.verdict import by_log, measure_of

    files = write_table(folder, rows)
    if any(measure_of(variants) for variants in by_log(rows).values()):
        write_bytes(folder / PICTURE, as_png(draw_sweep(rows)))
        files.append(folder / PICTURE)
    return files


def show_errors(rows: Sequence[Row]) -> None:
    """Print the errors of each log by variant, and the reasons of failed runs."""
    from impslam.sweeps.statistics import MEDIAN_95, Quantiles
    from impslam.sweeps.verdict import (
        MEASURES,
        by_log,
        log_names,
        measure_of,
        values_of,
        variant_name,
    )

    cells, logs = [], by_log(rows)
    for log, variants in zip(log_names(logs), logs.values(), strict=True):
        measure = measure_of(variants)
        for variant, runs in variants.items():
            values = values_of(runs, measure) if measure else []
            spread = str(Quantiles.of(100.0 * value for value in values)) if values else "-"
            seconds = f"{median(run['cpu_s'] for run in runs):.2f}"
            name = MEASURES.get(measure, "nothing known")
            cells.append((log, variant, name, str(len(runs)), spread, seconds))
    if cells:
        header = ("log", "config and settings", "error, cm", "runs", MEDIAN_95, "CPU s")
        console.show_table(header, cells, numbers=3)
    failed = [row for row in rows if row["error"]]
    for row in failed[:MAX_FAILURES_SHOWN]:
        console.echo(
            f"failed: {row['log']}, {variant_name(row)}, seed {row['seed']}: {row['error']}"
        )
    if len(failed) > MAX_FAILURES_SHOWN:
        console.echo(f"failed: {len(failed) - MAX_FAILURES_SHOWN} more; see the column message")
