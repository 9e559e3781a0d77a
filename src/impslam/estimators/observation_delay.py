"""The uncertainty of observations that were measured before or after the keyframe's stamp."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from impslam.landmarks.base import LandmarkModel
from impslam.types import Increment, Observation


def blurred(
    observations: tuple[Observation, ...], motion: Increment, models: Mapping[str, LandmarkModel]
) -> tuple[Observation, ...]:
    """Add the uncertainty of the motion between the stamps of keyframe and observation to R."""
    delayed: dict[str, list[int]] = {}
    for i, o in enumerate(observations):
        if o.delay:
            delayed.setdefault(o.kind, []).append(i)
    if motion.duration == 0.0 or not delayed:
        return observations
    rate, out = motion.covariance / motion.duration, list(observations)
    for kind, indices in delayed.items():
        J = models[kind].z_D_motion(np.array([observations[i].z for i in indices]))
        for i, added in zip(indices, J @ rate @ J.swapaxes(1, 2), strict=True):
            o = observations[i]
            out[i] = o.with_noise(o.R + abs(o.delay) * added)
    return tuple(out)
