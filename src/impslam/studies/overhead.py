"""Accuracy of ground truth by an overhead camera, and of scores computed with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from impslam.evaluation.consistency import nees, pose_errors
from impslam.evaluation.overhead_plot import draw_track
from impslam.evaluation.plots import as_png
from impslam.evaluation.trajectory import associate, ate
from impslam.overhead.setup import Setup, load_setup
from impslam.overhead.track import Tracked, track
from impslam.simulation.drive import drive
from impslam.simulation.overhead_files import write_film
from impslam.simulation.robot import OverheadCamera
from impslam.simulation.scene import Scene
from impslam.simulation.world import World, load_world
from impslam.studies.report import Picture, ResultTable, Section, load_text
from impslam.studies.sweep import Variant, simulate_and_map
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.job import Job, ignore_progress
from impslam.sweeps.rows import Row
from impslam.sweeps.statistics import MEDIAN_95, Quantiles
from impslam.types import Array

SEEDS = 2  # default, for a quick look
CAMERA = OverheadCamera(rate=2.0, hidden=((30.2, 35.2),))
HIDDEN = 10  # number of hidden pictures
FOUND: dict[str, tuple[str, float]] = {
    "place": ("RMS of the position, mm", 1e3),
    "heading": ("RMS of the heading, deg", 180.0 / math.pi),
    "nees": ("NEES of the poses (ideal 3)", 1.0),
    "sigma": ("estimated standard deviation of a position, mm", 1e3),
    "cylinders": ("RMS of the cylinders, mm", 1e3),
    "hidden": (f"pictures reported as hidden (of {HIDDEN})", 1.0),
    "slam_truth": ("error of the default against the simulator, mm", 1e3),
    "slam_camera": ("error of the default against the camera, mm", 1e3),
}
"""Metrics of a drive with their titles, and factors from the units of the rows (m, rad)."""


def overhead(job: Job) -> Section:
    """Film, track, map and score drives through the arena."""
    text = load_text("overhead")
    rows = job.map(measure, range(job.seeds or SEEDS), "film, track, map")
    cells = [
        (name, str(Quantiles.of(scale * float(row[key]) for row in rows)))
        for key, (name, scale) in FOUND.items()
    ]
    table = ResultTable(f"{len(rows)} drives", ("", MEDIAN_95), cells)
    tracked, setup, _ = film_and_track(load_world("arena"), 0)
    picture = Picture(
        "fig23-overhead", as_png(draw_track(tracked, setup), dpi=110), text["caption"]
    )
    numbers = {key: [row[key] for row in rows] for key in FOUND}
    return Section("overhead", text["title"], text["text"], [table], [picture], numbers, rows)


def film_and_track(world: World, seed: int) -> tuple[Tracked, Setup, Array]:
    """Return the tracking result, its setup, and the true poses (n, 3) of the pictures."""
    trajectory = drive(world.robot)
    with TemporaryDirectory() as folder:
        video = Path(folder) / "overhead.mp4"
        start = ROBOT.start_time
        write_film(video, CAMERA, Scene(world), trajectory, start, seed, lambda _: None)
        setup = load_setup(video.with_suffix(".toml"))
        tracked = track(video, setup, video.parent, ignore_progress)
    return tracked, setup, trajectory.at(tracked.stamps - start)


def measure(seed: int) -> Row:
    """Return the metrics in `FOUND` for one drive, in m and rad."""
    world = load_world("arena")
    tracked, _, true = film_and_track(world, seed)
    errors = pose_errors(tracked.found.poses.copy(), true)
    run = simulate_and_map(world, [Variant("default")], seed)["default"]
    path = np.column_stack([run.rows.stamps, run.path])
    truth = np.column_stack([run.rows.stamps, run.truth])
    by_camera = np.column_stack([tracked.stamps, tracked.found.poses])
    return {
        "seed": seed,
        "place": _rms(errors[:, :2]),
        "heading": _rms(errors[:, 2:]),
        "nees": float(nees(errors, tracked.found.covariances).mean()),
        "sigma": math.sqrt(float(np.trace(tracked.found.covariances[:, :2, :2].mean(axis=0)))),
        "cylinders": _rms(_cylinder_errors(world, tracked)),
        "hidden": len(tracked.hidden),
        "slam_truth": ate(associate(path, truth)).rmse,
        "slam_camera": ate(associate(path, by_camera)).rmse,
    }


def _rms(errors: Array | Sequence[Array]) -> float:
    """Return the root mean square length of errors (n, k); infinite without errors."""
    rows = np.asarray(errors)
    return math.sqrt(float(np.mean(np.sum(rows**2, axis=1)))) if len(rows) else math.inf


def _cylinder_errors(world: World, tracked: Tracked) -> list[Array]:
    """Return the errors (2,) m of the cylinders; an empty list if the number of cylinders is wrong."""
    if len(tracked.cylinders) != len(world.cylinders):
        return []
    true = np.array([part.centre for part in world.cylinders])
    gaps = (true - cylinder.centre for cylinder in tracked.cylinders)
    return [gap[np.argmin(np.hypot(*gap.T))] for gap in gaps]
