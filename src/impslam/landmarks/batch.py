"""Batch compiled predictions over leading axes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impslam.landmarks.base import Prediction
from impslam.types import Array


def batched(
    predict: Callable[[Array, Array], tuple[Array, Array, Array]], pose: Array, m: Array
) -> Prediction:
    """Apply a kernel for poses (b, 3) and m (b, k, dim) to any leading axes."""
    if pose.ndim == 1 and m.ndim == 2:
        z, z_D_pose, z_D_m = predict(pose[None], m[None])
        return Prediction(z[0], z_D_pose[0], z_D_m[0])
    lead = np.broadcast_shapes(pose.shape[:-1], m.shape[:-2])
    poses = np.ascontiguousarray(np.broadcast_to(pose, (*lead, 3))).reshape(-1, 3)
    states = np.ascontiguousarray(np.broadcast_to(m, (*lead, *m.shape[-2:])))
    parts = predict(poses, states.reshape(len(poses), *m.shape[-2:]))
    return Prediction(*(part.reshape(*lead, *part.shape[1:]) for part in parts))
