"""`imp evaluate`: errors of runs against ground truth or relations, and the agreement of their scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from impslam.cli.console import Common, Output
from impslam.errors import ConfigError
from impslam.evaluation.options import GATE, Alignment


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Against:
    """What to compare runs with, and how.

    Parameters
    ----------
    truth
        TUM file of the true path. Default: the one in the run's folder.
    landmarks
        CSV file of the true landmarks. Default: the one in the run's folder.
    relations
        Relation file of the SLAM benchmarking suite.
    align
        Align the path with the truth by the best fit, at the start, or not at all.
    delta
        Distance over which the relative pose error is computed, m.
    gate
        Maximum distance between a landmark and the true one that it matches, m.
    """

    truth: Path | None = None
    landmarks: Path | None = None
    relations: Path | None = None
    align: Alignment = "fit"
    delta: float = 1.0
    gate: float = GATE


DEFAULT = Against()


def evaluate(
    *runs: Path,
    against: Against = DEFAULT,
    output: Output = None,
    json: Path | None = None,
    common: Common | None = None,
) -> None:
    """Print the errors of runs against ground truth or relations, and the agreement of their scans.

    Parameters
    ----------
    runs
        Run folders, or trajectories as TUM files; each is a row of the table.
    output
        PNG file to draw the comparison to.
    json
        JSON file to write all numbers to.
    """
    if not runs:
        raise ConfigError("no run given; name a run folder, or a trajectory as a TUM file")
    if not (0.0 < against.delta < math.inf and 0.0 < against.gate < math.inf):
        raise ConfigError("--delta and --gate are lengths in m, greater than 0")
    from impslam.cli.output_files import check_png
    from impslam.cli.run_folder import RUN_FILES
    from impslam.cli.scoring import compare
    from impslam.paths import keep_inputs

    if output is not None:
        check_png(output)
    parts = [run / name for run in runs for name in RUN_FILES]
    keep_inputs([against.truth, against.landmarks, against.relations], [output, json])
    keep_inputs([run for run in runs if not run.is_dir()] + parts, [output, json])
    compare(runs, against, output, json, quiet=common is not None and common.quiet)
