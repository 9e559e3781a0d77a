"""Maps of made-up buildings, and what a robot sees in them."""

import numpy as np
from tests.extractors.scans import cast
from tests.recognition.plans import ANGLES

from impslam.map import Keyframes
from impslam.map_builder import valid_points
from impslam.maps.layout import undriven
from impslam.types import Array

LASER = np.array([0.2, 0.05, 0.0])


def seen(plan, pose, seed=0, **more):
    """Return the scan of a plan from a pose (3,) of base_link."""
    rng = np.random.default_rng(seed)
    scene = cast(
        plan, pose=np.asarray(pose, float), laser=LASER, angles=ANGLES, noise=0.01,
        range_max=20.0, rng=rng, **more,
    )  # fmt: skip
    return scene.scan


def mapped(plan, poses: Array) -> Keyframes:
    """Return keyframes at true poses (k, 3)."""
    scans = [valid_points(seen(plan, pose, k)) for k, pose in enumerate(poses)]
    n = len(poses)
    return Keyframes(
        np.arange(n, dtype=float),
        poses,
        np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile(LASER[:2], (n, 1)),
        np.concatenate([[0], np.cumsum([len(points) for points in scans])]),
        np.concatenate(scans),
        **undriven(poses),
    )
