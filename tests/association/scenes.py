"""Scenes for association: a filter with a map, and what a robot at a true pose would see of it."""

import numpy as np
from tests.filters.worlds import MODELS, wall_seen
from tests.numeric import drawn

from impslam.filters.ekf import Ekf
from impslam.geometry.se2 import inverse, transform
from impslam.types import Increment, Observation

R_POINT = 1e-4 * np.eye(2)
R_WALL = np.diag([1e-4, 2.5e-5])


def point(pose, place, label=None, kind="cylinder", rng=None):
    """A point of the map as seen from a pose."""
    z = transform(inverse(pose), np.asarray(place, float)[None])[0]
    z = z if rng is None else drawn(rng, z, R_POINT)
    return Observation(kind, z, R_POINT, label=label)


def wall(pose, ends, label=None):
    """A wall, given by its ends in map, as seen from a pose."""
    z, in_base = wall_seen(pose, np.asarray(ends, float))
    return Observation("wall", z, R_WALL, np.arange(50), in_base, label=label)


def mapped(landmarks, moved=(0.0, 0.0, 0.0), sigma=(0.01, 0.01, 0.005)):
    """A filter that saw the landmarks from the origin, then moved with this standard deviation."""
    belief = Ekf()
    belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    belief.extend(list(landmarks), 0.0)
    move(belief, moved, sigma)
    return belief


def move(belief, moved, sigma):
    """Dead-reckon once."""
    belief.predict(Increment(1.0, np.asarray(moved, float), np.diag(np.square(sigma)), 1.0))


def pairs(choice):
    """The matches as a dict from observation to landmark."""
    return {match.observation: match.landmark for match in choice.matches}
