"""The observability-constrained EKF for SLAM (Huang, Mourikis & Roumeliotis 2010; Hesch et al. 2014).

A rigid motion of robot and map together changes nothing that is seen: H N = 0 for the directions N of
the state along it. The textbook EKF's N changes with every estimate. Here, as in `fej`, N is that of the
predicted pose and the landmarks' first states for ever, carried by the same F. But the measurement
Jacobians are those of the *newest* estimates, changed as little as it takes to leave N unobserved:

    H* = argmin |H* - H|  so that  H* N = 0,    H* = H - H N (N^T N)^-1 N^T,

the projection of each row onto what is orthogonal to N (Hesch et al. 2014, Eq. 30), over the pose and
the one landmark that the row sees. Rotations about any point and translations span the same N, and the
Frobenius norm favours no direction, so that the result does not depend on where the map's frame lies.

The price of `fej`, Jacobians with the first estimates' errors in them, is paid only as far as the
constraint asks for it.
"""

from __future__ import annotations

import numpy as np

from impslam.component import register
from impslam.filters.belief import POSE
from impslam.filters.ekf import Ekf
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.scene import Sight
from impslam.filters.symmetry import pose_D_motion
from impslam.landmarks.base import Prediction
from impslam.types import Array


def unobserving(J: Array, N: Array) -> Array:
    """Return the Jacobians (k, dim_z, n) nearest to J that are zero along N (k, n, 3)."""
    N_T = N.transpose(0, 2, 1)
    return np.asarray(J - J @ N @ np.linalg.solve(N_T @ N, N_T))


@register("oc")
class ObservabilityConstrainedEkf(FirstEstimatesEkf):
    """The EKF with Jacobians changed least so that what nothing observes stays unobserved."""

    def _expect(self, sight: Sight, pose: Array, states: Array) -> Prediction:
        now = Ekf._expect(self, sight, pose, states)
        first = sight.table.states(self._first, sight.places)
        of_pose = np.broadcast_to(pose_D_motion(self._first[:POSE]), (len(first), POSE, 3))
        N = np.concatenate([of_pose, sight.table.model.m_D_motion(first)], axis=1)
        J = unobserving(np.concatenate([now.z_D_pose, now.z_D_m], axis=2), N)
        return now._replace(z_D_pose=J[..., :POSE], z_D_m=J[..., POSE:])
