"""Maps made by hand: keyframes at known poses, and what they see of a plan."""

import numpy as np
from tests.extractors.scans import cast, regular_angles

from impslam.geometry.se2 import between, compose
from impslam.map import Keyframes, Map
from impslam.map_builder import valid_points
from impslam.maps.layout import undriven
from impslam.types import Edges

ANGLES = regular_angles(361, 2.0 * np.pi * 0.75)


def mapped(plan, truth, circles=None, T=(0.0, 0.0, 0.0), noise=0.01, seed=0, landmarks=()):
    """Return the map of a plan (w, 2, 2) that true poses (k, 3) give, as seen from another frame.

    What lies at p in the plan lies at T p in the map; two sweeps hang on each keyframe. The seed determines
    the noise of the scans and of odometry.
    """
    rng, k = np.random.default_rng(seed), len(truth)
    look = {"angles": ANGLES, "noise": noise, "range_max": 20.0, "rng": rng}
    points = [valid_points(cast(plan, circles, pose=pose, **look).scan) for pose in truth]
    poses = compose(np.array(T, float), np.array(truth, float))
    spread = np.tile(np.diag([1e-4, 4e-4, 1e-5]), (k, 1, 1))
    keyframes = Keyframes(
        np.arange(float(k)), poses, spread, np.zeros((k, 3)), np.zeros((k, 2)),
        np.cumsum([0, *map(len, points)]), np.concatenate(points), **undriven(poses),
    )  # fmt: skip
    anchors = np.repeat(np.arange(k), 2)
    steps = np.tile([[0.0, 0.0, 0.0], [0.1, 0.0, 0.02]], (k, 1))
    i = np.arange(k - 1)
    edges = Edges(
        i, i + 1, between(poses[:-1], poses[1:]), np.tile(1e4 * np.eye(3), (k - 1, 1, 1)),
        np.full(k - 1, np.inf),
    )  # fmt: skip
    path = compose(poses[anchors], steps)
    odometry = path + np.cumsum(rng.normal(0.0, 0.003, path.shape), axis=0)
    return Map(
        keyframes, tuple(landmarks), np.arange(2.0 * k) / 2, anchors, steps,
        np.tile([1e-5, 0, 0, 1e-5, 0, 1e-6], (2 * k, 1)), odometry, path, steps, edges,
        about={"log": "drawn"},
    )  # fmt: skip
