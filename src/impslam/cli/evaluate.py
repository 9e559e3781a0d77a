"""`imp evaluate`: how far runs are from a truth, or from measured relations, and how well scans agree."""

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
    """What runs are compared with, and how.

    Parameters
    ----------
    truth
        The true path, as a TUM file. Default: the one in the run's folder.
    landmarks
        The true landmarks, as a CSV file. Default: those in the run's folder.
    relations
        A relation file of the SLAM benchmarking suite.
    align
        Align the path with the truth by the best fit, at its start, or not at all.
    delta
        Length over which the relative pose error is taken, m.
    gate
        Largest distance of a landmark from the true one, m.
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
    """Print the errors of runs against the truth or measured relations, and how well their scans agree.

    Parameters
    ----------
    runs
        Folders of runs, or trajectories as TUM files; one row of the table each.
    output
        Draw the comparison: a PNG file.
    json
        Write all numbers: a JSON file.
    """
    if not runs:
        raise ConfigError("no run given; name the folder of a run, or a trajectory as TUM file")
    if not (0.0 < against.delta < math.inf and 0.0 < against.gate < math.inf):
        raise ConfigError("--delta and --gate are lengths in m, greater than 0")
    if output is not None and output.suffix.lower() != ".png":
        raise ConfigError(f"{output}: is drawn as a PNG; give -o NAME.png")
    from impslam.cli.scoring import compare

    compare(runs, against, output, json, quiet=common is not None and common.quiet)
