"""`imp demo`: simulate the arena of the thesis, map it, and print the map beside the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numba.core import event

from impslam.cli import console
from impslam.cli.interruption import Interruption
from impslam.cli.job import execute
from impslam.cli.progress import display
from impslam.cli.run_folder import run_folder
from impslam.cli.simulate import truth_path, write_log
from impslam.evaluation.landmark_files import landmarks_path
from impslam.evaluation.landmarks import corners, score_landmarks
from impslam.geometry.angles import wrap
from impslam.map import Map
from impslam.observers.base import Outcome
from impslam.observers.ending import EndOfRun
from impslam.open_log import open_log
from impslam.simulation.world import load_world
from impslam.types import Array, Landmark, TrueLandmark

WORLD = "arena"
LOG = Path(f"{WORLD}.mcap")
LOG_FILES = frozenset(map(str, (LOG, truth_path(LOG), landmarks_path(LOG))))
"""Files of the simulated log."""
MIN_COMPILE_TIME = 0.5  # s; shorter times are not printed


def map_arena(
    seed: int,
    output: Path | None,
    config: str | None,
    settings: Sequence[str],
    *,
    force: bool,
    quiet: bool,
    interruption: Interruption,
) -> None:
    """Simulate the arena, map it, and print the map beside the truth."""
    clock, world, end = DemoClock(), load_world(WORLD), EndOfRun()
    start = list(map(float, world.robot.start))
    with run_folder(output, WORLD, force=force, also=LOG_FILES) as folder:
        log = folder / LOG
        with clock("simulate the arena"), display(quiet) as progress:
            scans = write_log(world, log, seed, progress)
        interruption.check()
        if not quiet:
            place = (output or folder) / LOG
            console.echo(f"recorded {scans} scans, wheel encoders and gyro to {place}; mapping ...")
        with clock("map and report"):
            chosen, source = open_log(log, config, [f"start={start}", f"seed={seed}", *settings])
            true = world.landmarks()
            known = execute(
                chosen, source, folder, quiet,
                more=[end], true_landmarks=true, interruption=interruption,
            )  # fmt: skip
    folder = output or folder
    if not quiet:
        _show_landmarks(world.landmarks(), known)
        _show_end(end)
        _show_times(clock, end.outcome)
        console.echo(f"report: {folder / 'report.html'}")


class DemoClock:
    """Measures the seconds of each part of the demo, and separately the time spent compiling."""

    def __init__(self) -> None:
        self.parts: dict[str, float] = {}
        self.compiling = 0.0

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Time a part."""
        before, begin = self.compiling, time.perf_counter()
        with event.install_timer("numba:compile", self._compiled):
            yield
        took = time.perf_counter() - begin
        self.parts[part] = took - (self.compiling - before)

    def _compiled(self, seconds: float) -> None:
        self.compiling += seconds


def _show_landmarks(truth: list[TrueLandmark], known: Map) -> None:
    """Print every true landmark beside its estimate; corners, implied by walls, only if found."""
    score = score_landmarks(known.landmarks, [*truth, *corners(truth)])
    found = {error.name: error for error in score.found}
    marks = {mark.id: mark for mark in known.landmarks}
    rows = []
    for true in [*truth, *(corner for corner in corners(truth) if corner.name in found)]:
        estimate, errors = ("missed", ""), ("-", "")
        if true.name in found:
            error = found[true.name]
            estimate = _position(marks[error.id])
            turn = "" if true.end_points is None else f"{math.degrees(error.angle):.2f}"
            errors = f"{100 * error.distance:.1f}", turn
        rows.append((true.name, *_position(true), *estimate, *errors))
    header = ("landmark", "true", "", "estimated", "", "error, cm", "error, deg")
    console.show_table(header, rows, numbers=6)
    for number in score.false:
        console.echo(f"not in the arena: {marks[number].kind} {' '.join(_position(marks[number]))}")
    for number in score.doubles:
        console.echo(
            f"duplicate in the map: {marks[number].kind} {' '.join(_position(marks[number]))}"
        )


def _position(landmark: Landmark | TrueLandmark) -> tuple[str, str]:
    """Return x and y of a point, or distance and direction of a wall from the origin."""
    values = landmark.parameters
    if landmark.end_points is not None:
        return f"r {values['r']:.3f} m", f"{degrees(values['alpha']):z.2f} deg"
    x, y = landmark.position
    return f"x {x:z.3f} m", f"y {y:z.3f} m"


def degrees(angle: float) -> float:
    """Return an angle in rad as degrees in (-180, 180], rounded to hundredths."""
    rounded = round(math.degrees(angle), 2)
    return 180.0 if rounded == -180.0 else rounded


def _show_end(end: EndOfRun) -> None:
    """Print the true last pose beside the estimated one and that of odometry."""
    if end.true is None or end.pose is None or end.odometry is None:
        return
    rows = [("true", *_coordinates(end.true), "")]
    for name, pose in (("estimated", end.pose), ("odometry alone", end.odometry)):
        error = 100 * math.dist(pose[:2], end.true[:2])
        turn = math.degrees(wrap(float(pose[2] - end.true[2])))
        rows.append((name, *_coordinates(pose), f"{error:.1f} cm, {turn:+.2f} deg"))
    header = ("end of the path", "x, m", "y, m", "heading, deg", "error")
    console.show_table(header, rows, numbers=4)


def _coordinates(pose: Array) -> tuple[str, str, str]:
    return f"{pose[0]:z.3f}", f"{pose[1]:z.3f}", f"{degrees(pose[2]):z.2f}"


def _show_times(clock: DemoClock, outcome: Outcome | None) -> None:
    """Print the time of each part and the median time of each stage of mapping."""
    parts = [f"{name} {seconds:.1f} s" for name, seconds in clock.parts.items()]
    if clock.compiling > MIN_COMPILE_TIME:
        parts.append(f"compile {clock.compiling:.1f} s (first run only)")
    console.echo("time: " + ", ".join(parts))
    if outcome is not None:
        stages = {name: 1000 * float(np.median(times)) for name, times in outcome.stages.items()}
        console.echo("median: " + ", ".join(f"{name} {ms:.2f} ms" for name, ms in stages.items()))
