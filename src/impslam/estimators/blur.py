"""Observations of beams that are fired before or after a keyframe's moment."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from impslam.landmarks.base import LandmarkModel
from impslam.types import Increment, Observation


def blurred(
    observations: tuple[Observation, ...], motion: Increment, models: Mapping[str, LandmarkModel]
) -> tuple[Observation, ...]:
    """Add to R what the motion between a keyframe's moment and an observation's is unsure by."""
    late: dict[str, list[int]] = {}
    for i, o in enumerate(observations):
        if o.delay:
            late.setdefault(o.kind, []).append(i)
    if motion.duration == 0.0 or not late:
        return observations
    rate, out = motion.covariance / motion.duration, list(observations)
    for kind, indices in late.items():
        J = models[kind].z_D_motion(np.array([observations[i].z for i in indices]))
        for i, added in zip(indices, J @ rate @ J.swapaxes(1, 2), strict=True):
            o = observations[i]
            out[i] = o.with_noise(o.R + abs(o.delay) * added)
    return tuple(out)
