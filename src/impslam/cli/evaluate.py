"""`imp evaluate`: how far runs are from the truth, or from relations that people measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Common
from impslam.errors import ConfigError, ImpError
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.evaluation.trajectory import Pairs, associate, ate, heading_errors, rpe, statistics
from impslam.evaluation.tum import read_tum
from impslam.types import Array


def evaluate(
    *runs: Path,
    truth: Path | None = None,
    relations: Path | None = None,
    delta: Annotated[float, Parameter(help="Stretch of the relative pose error, m.")] = 1.0,
    common: Common | None = None,
) -> None:
    """Print the errors of runs against a true path (TUM) or against measured relations.

    Parameters
    ----------
    runs
        Folders of runs, or trajectories as TUM files; one row of the table each.
    truth
        The true path, as a TUM file.
    relations
        A relation file of the SLAM benchmarking suite.
    """
    del common
    if not runs:
        raise ConfigError("no run given; name the folder of a run, or a trajectory as TUM file")
    if (truth is None) == (relations is None):
        raise ConfigError("give either --truth FILE (TUM) or --relations FILE")
    estimates = {str(path): read_tum(_trajectory(path)) for path in runs}
    if truth is not None:
        _show_truth(estimates, read_tum(truth), delta)
    if relations is not None:
        _show_relations(estimates, read_relations(relations))


def _trajectory(path: Path) -> Path:
    """Return the trajectory of a run, or the file itself."""
    if path.is_dir() and not (path / "trajectory.tum").is_file():
        raise ConfigError(f"{path}: holds no trajectory.tum; give the folder of a run")
    return path / "trajectory.tum" if path.is_dir() else path


def _show_truth(estimates: dict[str, Array], truth: Array, delta: float) -> None:
    rows = []
    for name, estimate in estimates.items():
        pairs = associate(estimate, truth)
        free, fitted = ate(pairs, aligned=False), ate(pairs)
        turn = math.degrees(statistics(heading_errors(pairs.aligned())).rmse)
        figures = (free.rmse, fitted.rmse, fitted.max)
        meters, degrees = _relative(pairs, delta)
        rows.append(
            (name, str(free.count), *(f"{f:.4f}" for f in figures), f"{turn:.2f}", meters, degrees)
        )
    header = ("run", "poses", "ATE, m", "aligned, m", "max, m", "heading, deg")
    stretch = f"RPE per {delta:g} m"
    console.show_table((*header, f"{stretch}, m", "deg"), rows, numbers=7)
    console.say("ATE and RPE are root mean squares; aligned: after the rigid motion that fits best")


def _relative(pairs: Pairs, delta: float) -> tuple[str, str]:
    """Return the relative pose error, or dashes for a path shorter than the stretch."""
    try:
        metres, radians = rpe(pairs, delta)
    except ImpError:
        return "-", "-"
    return f"{metres.rmse:.4f}", f"{math.degrees(radians.rmse):.3f}"


def _show_relations(estimates: dict[str, Array], relations: Array) -> None:
    rows = []
    for name, estimate in estimates.items():
        errors = relation_errors(estimate, relations)
        degrees = np.degrees(errors.rotation)
        rows.append(
            (
                name,
                str(len(errors.translation)),
                str(errors.missing),
                _spread(errors.translation, 3),
                f"{errors.metres.median:.3f}",
                _spread(degrees, 2),
                f"{np.median(degrees):.2f}",
            )
        )
    header = ("run", "relations", "missing", "metres", "median", "degrees", "median")
    console.show_table(header, rows, numbers=6)


def _spread(errors: Array, digits: int) -> str:
    """Return mean and standard deviation, as the suite's tables give them."""
    return f"{errors.mean():.{digits}f} ± {errors.std():.{digits}f}"
