"""Drives through buildings, as an estimator is given them: keyframes with scans, and drift."""

import math
from itertools import pairwise

import numpy as np
from tests.extractors.scans import cast, regular_angles, room
from tests.filters.worlds import MODELS
from tests.recognition.plans import walls

from impslam.estimators.graph import Graph
from impslam.geometry.se2 import between
from impslam.map import Keyframe
from impslam.types import Increment

ANGLES = regular_angles(361, math.radians(270.0))
STEP, TURN = 0.4, 0.4  # m, rad between keyframes
SIGMA = np.array([0.01, 0.01, 0.003])  # m, m, rad of the motion between two keyframes


def box(x, y, width, depth):
    """Return the four sides of a box, its corner at x, y."""
    return room(x, x + width, y, y + depth)


RING = np.concatenate([
    room(0.0, 20.0, 0.0, 14.0),
    room(2.5, 17.5, 2.5, 11.5),
    box(4.0, 0.0, 0.8, 0.4), box(9.5, 2.1, 1.3, 0.4), box(13.0, 0.0, 0.3, 0.6),
    box(19.5, 4.0, 0.5, 1.5), box(17.5, 8.5, 0.4, 0.7), box(15.0, 13.4, 1.1, 0.6),
    box(8.0, 11.5, 0.6, 0.5), box(5.0, 13.7, 0.5, 0.3), box(0.0, 9.0, 0.5, 0.6),
    box(2.0, 5.0, 0.5, 1.0),
    walls([6.0, 0.0, 6.3, 0.5], [2.5, 8.0, 2.1, 8.4]),
])  # fmt: skip
"""A corridor that leads back into itself, 56 m, with things along it."""
LAP = ((3.0, 1.25), (18.75, 1.25), (18.75, 12.75), (1.25, 12.75), (1.25, 1.25), (3.0, 1.25))


def way(*corners):
    """Return poses (k, 3) along a way, `STEP` m or `TURN` rad apart."""
    headings = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(corners)]
    rows = [[*corners[0], headings[0]]]
    for (a, b), heading in zip(pairwise(corners), headings, strict=True):
        before = rows[-1][2]
        turn = math.remainder(heading - before, 2.0 * math.pi)
        n = math.ceil(abs(turn) / TURN)
        rows += [[*a, before + turn * s / n] for s in range(1, n + 1)]
        n = max(1, round(math.dist(a, b) / STEP))
        rows += [[*(np.array(a) + (np.array(b) - a) * s / n), heading] for s in range(1, n + 1)]
    return np.array(rows)


def motions(truth, drift=(0.0, 0.0, 0.0), rng=None):
    """Return the motions (k, 3) between poses (k, 3), the first by nothing; `drift` is of each metre."""
    d_pose = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
    d_pose += np.hypot(d_pose[:, :1], d_pose[:, 1:2]) * np.array(drift)
    return d_pose if rng is None else d_pose + SIGMA * rng.standard_normal(d_pose.shape)


def scanned(plan, pose, **how):
    """Return the scan of a plan (w, 2, 2) from a pose."""
    return cast(plan, pose=pose, **{"angles": ANGLES, "range_max": 20.0, **how}).scan


def keyframe(k, d_pose, scan=None, seen=()):
    """Return keyframe k, a second after the one before."""
    motion = Increment(float(k), np.array(d_pose, float), np.diag(SIGMA**2), 1.0)
    none = np.zeros((3, 3))
    return Keyframe(
        k, float(k), motion, none[0], none[0], none, None, 0, scan=scan, observations=tuple(seen)
    )


def keyframes(plan, truth, drift=(0.0, 0.0, 0.0), noise=0.01, rng=None):
    """Return the keyframes of a drive through a plan along true poses (k, 3)."""
    rng = rng or np.random.default_rng(7)
    moved = motions(truth, drift)
    scans = [scanned(plan, pose, noise=noise, rng=rng) for pose in truth]
    return [keyframe(k, *row) for k, row in enumerate(zip(moved, scans, strict=True))]


def begun(start=(0.0, 0.0, 0.0), **how):
    """Return a graph that starts at a pose."""
    made = Graph(**how)
    made.start(np.array(start, float), models=MODELS)
    return made


def driven(made, frames):
    """Give an estimator keyframes; return their revisions."""
    return [made.add(frame) for frame in frames]
