"""The arena of the thesis: the controlled experiments, what their runs are measured by, and the seeds."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impslam.columns import batches
from impslam.evaluation.landmarks import corners, score_landmarks
from impslam.geometry.se2 import compose
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.studies.report import load_text
from impslam.studies.sweep import Run, Variant, grid
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row
from impslam.sweeps.statistics import Quantiles
from impslam.types import TrueLandmark, TruePose

MIN_DRIFT = 0.3
"""m: only runs whose dead reckoning ends this far from the truth show what the map is worth."""
GATE = 0.5
"""m: an estimate further from a landmark is of something else."""
END = "end position"
THESIS, PRINTED_GATE, DEFAULT = "thesis", "2 m gate", "default"
"""Names of the variants in tables and figures."""
TEXT = load_text("arena")


@functools.cache
def true_landmarks() -> tuple[TrueLandmark, ...]:
    """Return walls and cylinders as the world names them, and the corners that the walls make."""
    named = load_world("arena").landmarks()
    return (*named, *corners(named))


NAMED = tuple(mark.name for mark in true_landmarks() if mark.kind != "corner")
CORNERS = tuple(mark.name for mark in true_landmarks() if mark.kind == "corner")


@dataclass(frozen=True)
class Experiment:
    """One of the three experiments, as `arena.toml` describes it.

    Attributes
    ----------
    names : the landmarks that it is about
    printed : what the thesis prints: centres and feet of normals (2,) by landmark, m, in map
    variants : ways to map: the thesis's, with the gate as printed where that matters, the default
    interpretations : other readings of what the thesis's text leaves open
    """

    name: str
    text: Mapping[str, Any]
    names: tuple[str, ...]
    printed: Mapping[str, Sequence[float]]
    variants: list[Variant]
    interpretations: list[Variant]

    @classmethod
    def load(cls, name: str) -> Experiment:
        """Return the experiment of that name."""
        text = TEXT[name]
        preset, gate = text["preset"], text.get("printed_gate")
        names = [m.name for kind in text["kinds"] for m in true_landmarks() if m.kind == kind]
        variants = [Variant(THESIS, preset), Variant(DEFAULT)]
        variants[1:1] = [Variant(PRINTED_GATE, preset, tuple(gate))] if gate else []
        others = grid([preset], text["interpretations"])
        return cls(name, text, tuple(names), text["printed"], variants, others)

    def expected(self, variant: str) -> tuple[str, ...]:
        """Return the landmarks that a variant is to find."""
        return NAMED if variant == DEFAULT else self.names


def landmark_metrics(run: Run) -> Row:
    """Return what became of the arena's landmarks.

    `missing` are names, `false` and `doubles` ids. `distance NAME` (m) is that of points, and across
    walls at their middles; `foot NAME` is between the feet of walls' normals, as the thesis scores
    them. Both are infinite for a landmark that is missing.
    """
    score = score_landmarks(run.landmarks, true_landmarks(), GATE)
    found = {error.name: error for error in score.found}
    row: Row = {"missing": score.missing, "false": score.false, "doubles": score.doubles}
    for name in NAMED:
        row[f"distance {name}"] = found[name].distance if name in found else math.inf
        row[f"foot {name}"] = found[name].foot if name in found else math.inf
    return row | {f"{what} {END}": float(run.errors[-1]) for what in ("distance", "foot")}


def summary(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of one variant, which is to find the named landmarks."""

    def seeds(metric: str, among: Sequence[str] | None = None) -> list[int]:
        """Return the seeds whose metric, a list, holds anything, or anything of some names."""
        wanted = (set(r[metric]) & set(among) if among else r[metric] for r in rows)
        return [row["seed"] for row, some in zip(rows, wanted, strict=True) if some]

    def quantiles(what: str) -> dict[str, Quantiles]:
        return {n: Quantiles.of(r[f"{what} {n}"] for r in rows) for n in (*names, END)}

    return {
        "distance": quantiles("distance"),
        "foot": quantiles("foot"),
        "seeds_missing": seeds("missing", names),
        "seeds_false": seeds("false"),
        "seeds_double": seeds("doubles"),
        "seeds_corner_missing": seeds("missing", CORNERS),
        "pose_nees": float(np.mean([row["nees"] for row in rows])),
        "pose_nees_within_95": float(np.mean([row["nees_within"] for row in rows])),
    }


def dead_reckoning_error(seed: int) -> float:
    """Return how far the wheels alone end from the truth, m; nothing is estimated for it."""
    world, robot = load_world("arena"), SimulatedRobot(lidar=None, imu=None, truth_rate=1.0)
    config = Variant(DEFAULT).config(world, seed)
    blind, truth = config.make_robot(), np.zeros(3)
    messages = ((type(message).__name__, message) for message in simulate(world, robot, seed))
    for part in batches(messages):
        blind.sense(part)
        if TruePose.__name__ in part:
            truth = part[TruePose.__name__]["pose"][-1]
    pose = compose(np.array(config.start), blind.ahead().d_pose)
    return float(math.dist(pose[:2], truth[:2]))


_DRIFT: dict[int, float] = {}
"""Dead reckoning's error by seed, m: the three experiments use the same seeds."""


def drifting_seeds(job: Job, number: int) -> list[int]:
    """Return the first seeds 0, 1, ... whose dead reckoning ends `MIN_DRIFT` or more off."""
    found: list[int] = []
    begin = 0
    while len(found) < number:
        batch = range(begin, begin + number)
        unknown = [seed for seed in batch if seed not in _DRIFT]
        drifts = job.map(dead_reckoning_error, unknown, "dead reckoning") if unknown else []
        _DRIFT.update(zip(unknown, drifts, strict=True))
        found += [seed for seed in batch if _DRIFT[seed] >= MIN_DRIFT]
        begin += number
    return found[:number]
