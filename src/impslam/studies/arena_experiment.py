"""The controlled experiments in the arena of the thesis, and the metrics of their runs."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impslam.evaluation.landmarks import corners, score_landmarks
from impslam.simulation.world import load_world
from impslam.studies.report import load_text
from impslam.studies.sweep import StudyRun, Variant, grid
from impslam.sweeps.rows import Row
from impslam.sweeps.statistics import Quantiles
from impslam.types import TrueLandmark

END = "end position"
THESIS, PRINTED_GATE, DEFAULT = "thesis", "2 m gate", "default"
"""Names of the variants in tables and figures."""
TEXT = load_text("arena")


@functools.cache
def true_landmarks() -> tuple[TrueLandmark, ...]:
    """Return the named walls and cylinders of the world, and the corners of the walls."""
    named = load_world("arena").landmarks()
    return (*named, *corners(named))


NAMED = tuple(mark.name for mark in true_landmarks() if mark.kind != "corner")
CORNERS = tuple(mark.name for mark in true_landmarks() if mark.kind == "corner")


@dataclass(frozen=True)
class Experiment:
    """One of the three experiments, as `arena.toml` describes it.

    Attributes
    ----------
    names : the landmarks of the experiment
    printed : values in the thesis: centres and feet of normals (2,) by landmark, m, in map
    variants : the thesis's, with the printed gate if that matters, and the default
    interpretations : other interpretations of ambiguous text in the thesis
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
        """Return the landmarks that a variant should find."""
        return NAMED if variant == DEFAULT else self.names


def landmark_metrics(run: StudyRun) -> Row:
    """Return the errors of the arena's landmarks.

    `missing` are names, `false` and `doubles` ids. `distance NAME` (m) is that of points, and perpendicular
    to walls at their middles; `foot NAME` is between the feet of walls' normals, as in the thesis. Both are
    infinite for a missing landmark.
    """
    score = score_landmarks(run.landmarks, true_landmarks())
    found = {error.name: error for error in score.found}
    row: Row = {"missing": score.missing, "false": score.false, "doubles": score.doubles}
    for name in NAMED:
        row[f"distance {name}"] = found[name].distance if name in found else math.inf
        row[f"foot {name}"] = found[name].foot if name in found else math.inf
    return row | {f"{what} {END}": float(run.errors[-1]) for what in ("distance", "foot")}


def summary(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of one variant that should find the named landmarks."""

    def seeds(metric: str, among: Sequence[str] | None = None) -> list[int]:
        """Return the seeds with a non-empty metric, optionally restricted to some names."""
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
