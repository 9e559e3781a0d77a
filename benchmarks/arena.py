"""The arena of the thesis, simulated with a seed, mapped, and scored against the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impslam.config import load
from impslam.evaluation.landmarks import LandmarkScore, score_landmarks
from impslam.pipeline import Pipeline
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import StepResult, TruePose

CYLINDER, END, WALL = 0.03, 0.03, 0.02  # m, what the default preset is to keep


@dataclass(frozen=True)
class ArenaScore:
    """Errors of one run, m; a wall's is across it, at its middle."""

    seed: int
    landmarks: LandmarkScore
    end: float
    wheels: float

    def worst(self, kind: str) -> float:
        """Return the largest error of a kind of landmark; infinite if one is missing."""
        if self.landmarks.missing:
            return math.inf
        return max(e.distance for e in self.landmarks.found if e.kind == kind)

    @property
    def kept(self) -> bool:
        """Tell whether every limit is kept and nothing else of these kinds is in the map."""
        return (
            self.worst("cylinder") <= CYLINDER
            and self.worst("wall") <= WALL
            and self.end <= END
            and not self.landmarks.false
        )


def arena(seed: int, preset: str = "imp", settings: Sequence[str] = ()) -> ArenaScore:
    """Simulate and map the arena."""
    world = load_world("arena")
    start = list(map(float, world.robot.start))
    pipeline = Pipeline(load(preset, [f"start={start}", f"seed={seed}", *settings]))
    truth: dict[float, TruePose] = {}
    steps: list[StepResult] = []
    for message in simulate(world, seed=seed):
        if isinstance(message, TruePose):
            truth[message.stamp] = message
        steps.extend(pipeline.feed(message))
    steps.extend(pipeline.flush())
    last = steps[-1]
    true = truth[last.stamp].pose
    return ArenaScore(
        seed,
        score_landmarks(pipeline.slam.landmarks(), world.landmarks()),
        float(np.hypot(*(last.pose - true)[:2])),
        float(np.hypot(*(last.odometry - true)[:2])),
    )
