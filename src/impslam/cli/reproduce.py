"""`imp reproduce`: the tables and figures of the thesis, and the studies that go beyond it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Common, Flag, Force, Jobs, Output, whole_number
from impslam.cli.progress import StageBars, display
from impslam.cli.run_folder import run_folder
from impslam.component import near_miss
from impslam.errors import ConfigError
from impslam.paths import written

if TYPE_CHECKING:
    from impslam.studies.report import Section, Study

EXPERIMENTS = {
    "points": ("arena:points", 100),
    "lines": ("arena:lines", 100),
    "both": ("arena:both", 100),
    "features": ("features:features", 100),
    "corridor": ("corridor:corridor", 100),
    "figures": ("chapter4:figures", 1),
    "drawings": ("drawings:drawings", 1),
    "overhead": ("overhead:overhead", 20),
    "wheels": ("speed_control:speed_control", 1),
    "extractors": ("extractors:extractors", 10),
    "consistency": ("consistency:consistency", 1000),
    "faults": ("faults:faults", 3),
    "filters": ("filter_table:filter_table", 100),
}
"""Each experiment's module and function (imported when needed) and the number of seeds of the documented
figures, in the order of the report."""
ALL = "all"


Runs: TypeAlias = Annotated[
    int | None,
    Parameter(
        help="Simulated runs per experiment. Default: 1 to 100, depending on the experiment.",
        converter=whole_number,
    ),
]


def reproduce(
    *experiments: str,
    seeds: Runs = None,
    full: Annotated[Flag, Parameter(help="Use as many runs as the documented figures.")] = False,
    jobs: Jobs = None,
    data: Annotated[
        Path | None, Parameter(help="Folder of the public logs. Default: simulated drives only.")
    ] = None,
    output: Output = None,
    force: Force = False,
    common: Common | None = None,
) -> None:
    """Run experiments of the thesis and write their tables and figures to a folder.

    The folder contains report.html, report.md, a PNG or SVG for each figure, figures.json with the
    numbers, and a CSV file for each experiment that maps simulated drives, with a row for each run.

    Parameters
    ----------
    experiments
        Any of points, lines, both, features, corridor, figures, drawings, overhead, wheels, extractors,
        consistency, faults, filters. Default: all.
    output
        New folder for the results. Default: runs/reproduce-DATE-TIME.
    """
    # Imported here because no other command needs the studies.
    from impslam.studies.report import PAGE, write
    from impslam.sweeps.job import Job

    names = _chosen(experiments)
    _check(seeds, jobs, data, full=full)
    quiet = common is not None and common.quiet
    command = ["imp", "reproduce", *experiments, *(["--seeds", str(seeds)] if seeds else [])]
    command += ["--full"] if full else []
    parts: list[Section] = []
    with _folder(output, force=force) as folder, display(quiet) as progress:
        try:
            for name in names:
                runs = seeds or (EXPERIMENTS[name][1] if full else None)
                job = Job(runs, jobs or os.cpu_count() or 1, StageBars(progress, name), data)
                parts.append(_study(name)(job))
        finally:
            if parts:  # if a later experiment is interrupted, keep hours of work
                missing = names[len(parts) :]
                with written(folder, "free disk space or give another -o"):
                    write(folder, parts, shlex.join(command), missing)
    if not quiet:
        _show(parts)
        console.echo(f"report: {(output or folder) / PAGE}")


def _check(seeds: int | None, jobs: int | None, data: Path | None, *, full: bool) -> None:
    """Reject options that contradict each other or have unusable values."""
    if full and seeds is not None:
        raise ConfigError("--full and --seeds: give only one of them")
    for what, number in (("--seeds", seeds), ("--jobs", jobs)):
        if number is not None and number < 1:
            raise ConfigError(f"{what} {number}: must be at least 1")
    if data is not None and not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")


def _folder(wanted: Path | None, *, force: bool) -> AbstractContextManager[Path]:
    """Yield the folder to write to; see `run_folder`."""
    from impslam.studies.report import MARKDOWN, NUMBERS, PAGE

    existing = wanted.iterdir() if wanted is not None and wanted.is_dir() else ()
    more = {path.name for path in existing if path.suffix in {".png", ".svg", ".csv"}}
    results = {PAGE, MARKDOWN, NUMBERS}
    return run_folder(wanted, "reproduce", force=force, results=results, also=more, marker=NUMBERS)


def _chosen(words: Iterable[str]) -> list[str]:
    requested = list(words) or [ALL]
    for word in requested:
        if word != ALL and word not in EXPERIMENTS:
            known = [ALL, *EXPERIMENTS]
            raise ConfigError(f"reproduce {word}: no such experiment; {near_miss(word, known)}")
    return [name for name in EXPERIMENTS if ALL in requested or name in requested]


def _study(name: str) -> Study:
    module, function = EXPERIMENTS[name][0].split(":")
    study: Study = getattr(import_module(f"impslam.studies.{module}"), function)
    return study


def _show(parts: Iterable[Section]) -> None:
    for part in parts:
        console.echo(f"\n{part.title}\n")
        for table in part.tables:
            numbers = len(table.header) - table.text
            console.show_table(table.header, table.rows, table.title, numbers)
            console.echo(table.note + "\n" if table.note else "")
