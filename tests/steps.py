"""What a run shows its observers, a step for each sweep, for tests to look at."""

from dataclasses import dataclass, field

import numpy as np

from impslam.columns import single_row
from impslam.observers.base import Observer


@dataclass
class Step:
    """A sweep's pose as it was known at the time, and what came of it if it was a keyframe."""

    stamp: float
    pose: np.ndarray
    covariance: np.ndarray
    odometry: np.ndarray
    observations: tuple = ()
    matches: tuple = ()
    added: tuple = ()
    removed: tuple = ()
    keyframe: bool = False


@dataclass
class Steps(Observer):
    """Keeps all it is shown."""

    results: list[Step] = field(default_factory=list)
    truths: dict = field(default_factory=dict)
    known: object = None
    outcome: object = None

    def follow(self, track, path):
        self.results += [Step(float(s), *rest) for s, *rest in zip(*path, strict=True)]

    def revise(self, keyframe, revision, path):
        (row,) = zip(*path, strict=True)
        facts = keyframe.observations, revision.matches, revision.added, revision.removed
        self.results.append(Step(float(row[0]), *row[1:], *facts, keyframe=True))

    def truth(self, pose):
        self.truths[pose.stamp] = pose.pose

    def finish(self, known, outcome):
        self.known, self.outcome = known, outcome


def feed(run, messages):
    """Give a run messages one at a time, as a live robot does."""
    for message in messages:
        order = getattr(run, "told", 0)
        run.told = order + 1
        run.feed(single_row(type(message).__name__, message, order))
