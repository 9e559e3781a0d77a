"""A small world of points and walls, observed exactly or with the noise that R says."""

import math

import numpy as np
from tests.numeric import drawn

from impslam.association.known import Known
from impslam.geometry.se2 import compose, inverse, transform
from impslam.landmarks.point import Corner, Cylinder
from impslam.landmarks.wall import Wall
from impslam.types import Increment, Observation

MODELS = {"cylinder": Cylinder(), "corner": Corner(), "wall": Wall()}
CYLINDERS = np.array([[2.0, 1.5], [-1.0, 3.0], [4.0, -2.0], [-3.0, -1.0], [0.5, -3.5]])
WALLS = np.array(
    [[[6, -5], [6, 5]], [[6, 5], [-6, 5]], [[-6, 5], [-6, -5]], [[-6, -5], [6, -5]]], float
)
R_POINT = np.array([[4e-4, 1e-4], [1e-4, 3e-4]])
R_WALL = np.array([[2e-4, 2e-5], [2e-5, 1e-4]])
Q = np.diag([0.02, 0.01, 0.02]) ** 2


def wall_seen(pose, ends):
    """Return z = [rho, alpha] and the end points of a wall seen from a pose."""
    a, b = transform(inverse(pose), ends)
    n = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
    n *= 1.0 if n @ a > 0 else -1.0
    return np.array([n @ a, math.atan2(n[1], n[0])]), np.array([a, b])


def observe(pose, rng=None):
    """Return every landmark as seen from a pose, labelled; with noise if given a generator."""
    seen = []
    for i, point in enumerate(transform(inverse(pose), CYLINDERS)):
        z = point if rng is None else drawn(rng, point, R_POINT)
        seen.append(Observation("cylinder", z, R_POINT, label=i))
    for i, ends in enumerate(WALLS):
        z, in_base = wall_seen(pose, ends)
        z = z if rng is None else drawn(rng, z, R_WALL)
        seen.append(Observation("wall", z, R_WALL, np.arange(50), in_base, label=100 + i))
    return tuple(seen)


def drive(steps, rng=None):
    """Yield (true pose, increment as felt) round a circle that turns through +-pi."""
    pose = np.zeros(3)
    for k in range(steps):
        d = np.array([0.3, 0.0, 0.15])
        pose = compose(pose, d)
        felt = d if rng is None else d + drawn(rng, np.zeros(3), Q)
        yield pose, Increment(float(k + 1), felt, Q, 1.0)


def step(belief, increment, observations):
    """Take in a motion and a scan, associated by labels; return the choice."""
    belief.predict(increment)
    choice = belief.associate(observations, Known())
    belief.correct(observations, choice.matches)
    belief.note(observations, choice.matches, increment.stamp)
    belief.extend([observations[i] for i in choice.new], increment.stamp)
    return choice
