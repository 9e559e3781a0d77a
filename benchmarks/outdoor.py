"""The car's outdoor logs against GPS and surveyed beacons: numbers, and pictures for the docs.

    python benchmarks/outdoor.py --data ../shared/data                  # figures
    python benchmarks/outdoor.py --data ../shared/data -o docs/images   # and pictures

The GPS has its own frame and no heading, and its antenna is at base_link: path and map are fitted rigidly
to the fixes. Fixes that are implausible by odometry are left out.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.real_logs import Run, final_covariance, run_log  # noqa: E402  found from the root of the project

from impslam.columns import messages  # noqa: E402  from the root
from impslam.evaluation.colours import ODOMETRY, PATH, POINT, TRUTH  # noqa: E402
from impslam.evaluation.consistency import chi2_bounds  # noqa: E402
from impslam.evaluation.fixes import plausible  # noqa: E402
from impslam.evaluation.landmarks import LandmarkScore, score_landmarks  # noqa: E402
from impslam.evaluation.plots import style  # noqa: E402
from impslam.evaluation.trajectory import (  # noqa: E402
    PosePairs,
    align,
    associate,
    position_errors,
    statistics,
)
from impslam.geometry.se2 import compose, inverse, transform  # noqa: E402
from impslam.sources.base import recognise  # noqa: E402
from impslam.types import Array, TrueLandmark, TruePose  # noqa: E402

INCHES = (9.0, 8.2)
SURVEY_SIGMA = 0.02  # m, of the beacons, according to the survey
FREE_SIGMA = 100.0  # m and rad: the frame of the map is free
GPS_ERROR = 2.0  # m, of a GPS without corrections under trees, at best


@dataclass(frozen=True, eq=False)
class Outdoor:
    """A run against its GPS, and its map against surveyed beacons where there are some.

    `path`, `wheels` and `marks` (n, 2) m are moved to the GPS's frame, path and wheels each by its own
    best fit; `errors` and `wheels_errors` (k,) m are those of the fixes (k, 2).
    """

    path: Array
    wheels: Array
    marks: Array
    fixes: Array
    left_out: int
    errors: Array
    wheels_errors: Array
    known: tuple[TrueLandmark, ...]
    beacons: LandmarkScore
    beacon_errors: Array
    nees: tuple[float, tuple[float, float]] | None = None  # of the beacons, as `map_nees` says


def score(seen: Run, log: Path) -> Outdoor:
    """Score a run by the fixes and beacons in its log."""
    with recognise(log)(path=log) as source:
        read = messages(source.batches())
        told = np.array([[m.stamp, *m.pose] for m in read if isinstance(m, TruePose)])
        known = tuple(source.true_landmarks())
    fixes = told[plausible(told, np.array(seen.wheels))]
    path, errors, T_gps_map = _fit(np.array(seen.path), fixes)
    wheels, wheels_errors, _ = _fit(np.array(seen.wheels), fixes)
    T_map_gps = inverse(T_gps_map)
    in_map = [
        TrueLandmark(b.name, b.kind, transform(T_map_gps, b.position), b.parameters) for b in known
    ]
    beacons = score_landmarks(seen.landmarks, in_map)
    marks = transform(T_gps_map, np.array([mark.position for mark in seen.landmarks]))
    off = np.array([e.distance for e in beacons.found])
    left_out = len(told) - len(fixes)
    return Outdoor(
        path, wheels, marks, fixes[:, 1:3], left_out, errors, wheels_errors, known, beacons, off
    )


def _fit(path: Array, fixes: Array) -> tuple[Array, Array, Array]:
    """Return a path (n, 2) in the GPS's frame, its distances from the fixes, and the transform.

    The path is interpolated to the fixes, not they to it: between fixes that jump there is nothing.
    """
    pairs = associate(fixes, path, slack=0.0)
    pairs = PosePairs(pairs.stamps, pairs.truth, pairs.estimate)
    T_gps_map = align(pairs.estimate[:, :2], pairs.truth[:, :2])
    moved = compose(T_gps_map, path[:, 1:])[:, :2]
    return moved, position_errors(pairs.moved(T_gps_map)), T_gps_map


def map_nees(seen: Run, scored: Outdoor, log: Path) -> tuple[float, tuple[float, float]]:
    """Return the NEES of the beacons per degree of freedom, and its 95 % interval if sigmas are true.

    The whole map's, correlations included. Where it lies as a whole is not the map's to know: the
    survey is moved to where it fits best, which costs three degrees of freedom.
    """
    P = final_covariance(log)
    ids = {mark.id: i for i, mark in enumerate(seen.landmarks)}
    rows = np.array([ids[e.id] for e in scored.beacons.found])
    columns = (3 + 2 * rows[:, None] + np.arange(2)).ravel()
    C = P[np.ix_(columns, columns)]
    # In a filter's own coordinates P may differ by rigid motions of the map, which are free here.
    own = [seen.landmarks[i].covariance for i in rows]
    blocks = [C[k : k + 2, k : k + 2] for k in range(0, len(C), 2)]
    assert np.allclose(blocks, own, rtol=0.01, atol=1e-5)  # of the same beacons
    points = np.array([seen.landmarks[i].position for i in rows])
    places = {true.name: true.position for true in scored.known}
    survey = np.array([places[e.name] for e in scored.beacons.found])
    error = (points - transform(align(survey, points), survey)).ravel()
    moves = np.zeros((len(error), 3))
    moves[0::2, 0] = moves[1::2, 1] = 1.0
    moves[0::2, 2], moves[1::2, 2] = -points[:, 1], points[:, 0]
    S = C + SURVEY_SIGMA**2 * np.eye(len(C)) + FREE_SIGMA**2 * moves @ moves.T
    dof = len(error) - 3
    low, high = chi2_bounds(dof)
    return float(error @ np.linalg.solve(S, error)) / dof, (low / dof, high / dof)


def carpark(data: Path, folder: Path | None = None) -> tuple[Run, Outdoor]:
    """Map the car park by its reflecting beacons."""
    log = data / "carpark"
    seen = run_log(log, folder=folder)
    scored = score(seen, log)
    return seen, replace(scored, nees=map_nees(seen, scored, log))


def victoria_park(data: Path, folder: Path | None = None) -> tuple[Run, Outdoor]:
    """Map Victoria Park by its trees."""
    seen = run_log(data / "victoria-park", folder=folder)
    return seen, score(seen, data / "victoria-park")


def carpark_figures(seen: Run, scored: Outdoor) -> str:
    """Return the text on the car park for the docs."""
    path, wheels = statistics(scored.errors), statistics(scored.wheels_errors)
    found, beacons = len(scored.beacons.found), scored.beacons
    rms = math.sqrt(float(np.mean(scored.beacon_errors**2)))
    assert scored.nees is not None
    nees, (low, high) = scored.nees
    return (
        f"{found} of {len(scored.known)} beacons, {len(beacons.false) + len(beacons.doubles)} false, "
        f"{100 * rms:.1f} cm RMS, NEES {nees:.2f} per "
        f"degree of freedom (95 % interval {low:.2f} to {high:.2f}); path {100 * path.rmse:.1f} cm "
        f"RMS, median {100 * path.median:.1f} cm (wheels alone {wheels.rmse:.2f} m RMS); "
        f"{seen.speed:.0f} times real time"
    )


def victoria_park_figures(seen: Run, scored: Outdoor) -> str:
    """Return the text on Victoria Park for the docs."""
    path, wheels = statistics(scored.errors), statistics(scored.wheels_errors)
    near = 100.0 * float(np.mean(scored.errors < GPS_ERROR))
    return (
        f"{len(seen.landmarks)} trees; path from {path.count} fixes: median {path.median:.2f} m, "
        f"{near:.0f} % within {GPS_ERROR:g} m, {path.rmse:.2f} m RMS, {path.max:.0f} m at most "
        f"({scored.left_out} fixes left out; wheels alone {wheels.rmse:.0f} m RMS); "
        f"{seen.speed:.0f} times real time"
    )


# --------------------------------------------------------------------------- pictures


def picture(scored: Outdoor, target: Path, mark: str) -> None:
    """Draw path and landmarks (called `mark`) over the GPS and the survey."""
    figure = Figure(figsize=INCHES, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(facecolor="white")
    axes.plot(*scored.wheels.T, color=ODOMETRY, lw=0.8, label="wheels alone", zorder=1)
    axes.plot(*scored.fixes.T, ".", color=TRUTH, ms=4, label="GPS", zorder=3)
    axes.plot(*scored.path.T, color=PATH, lw=1.2, label="SLAM", zorder=4)
    axes.plot(*scored.marks.T, "+", color=POINT, ms=7, mew=1.5, label=mark, zorder=5)
    if scored.known:
        survey = np.array([true.position for true in scored.known])
        look: dict[str, Any] = {"mfc": "none", "mec": TRUTH, "mew": 1.3, "ms": 11, "zorder": 2}
        axes.plot(*survey.T, "o", label="surveyed beacon", **look)
    _frame(axes, np.vstack((scored.path, scored.marks)))
    figure.legend(loc="outside upper center", ncols=5, frameon=False, markerscale=1.5)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, metadata={"Software": None})


def _frame(axes: Any, points: Array) -> None:
    """Fit equal axes in m to the points; the path by odometry may leave the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.04 * float((high - low).max())
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set(xlabel="x in m", ylabel="y in m")
    style(axes)


JOBS = {
    "carpark": (carpark, carpark_figures, "beacon in the map"),
    "victoria-park": (victoria_park, victoria_park_figures, "tree in the map"),
}
"""By name of the log: the run, its figures as the docs say them, and what its landmarks are."""


def main() -> None:
    """Print the results of both logs, and draw them if an output folder is given."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("-o", "--out", type=Path, help="folder for the pictures")
    arguments = parser.parse_args()
    for name, (job, figures, mark) in JOBS.items():
        seen, scored = job(arguments.data)
        print(f"{name}: {figures(seen, scored)}", flush=True)
        if arguments.out is not None:
            picture(scored, arguments.out / f"{name}.png", mark)


if __name__ == "__main__":
    main()
