"""The observability-constrained EKF for SLAM (Huang, Mourikis & Roumeliotis 2010; Hesch et al. 2014).

A rigid motion of robot and map is unobservable: H N = 0 for the directions N of the state along it. The
textbook EKF's N changes with every estimate. Here, as in `fej`, N is always that of the predicted pose and
the landmarks' initial states, propagated by the same F. But the measurement Jacobians are those of the
*newest* estimates, with the smallest change that makes N unobservable:

    H* = argmin |H* - H|  so that  H* N = 0,    H* = H - H N (N^T N)^-1 N^T,

the projection of each row onto the complement of N (Hesch et al. 2014, Eq. 30), over the pose and the one
landmark of the row. Rotations about any point and translations span the same N, and the Frobenius norm is
isotropic, so the result does not depend on the map frame.

The errors of the first estimates affect the Jacobians only as far as the constraint requires, less than in
`fej`.
"""

from __future__ import annotations

import numpy as np

from impslam.component import register
from impslam.filters.belief import POSE
from impslam.filters.ekf import Ekf
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.matched_scan import MatchedKind
from impslam.filters.symmetry import pose_D_motion
from impslam.landmarks.base import Prediction
from impslam.types import Array


def unobserving(J: Array, N: Array) -> Array:
    """Return the Jacobians (k, dim_z, n) closest to J that are zero along N (k, n, 3)."""
    N_T = N.transpose(0, 2, 1)
    return np.asarray(J - J @ N @ np.linalg.solve(N_T @ N, N_T))


@register("oc")
class ObservabilityConstrainedEkf(FirstEstimatesEkf):
    """The EKF with minimally changed Jacobians that keep unobservable directions unobservable."""

    def _expect(self, kind: MatchedKind, pose: Array, states: Array) -> Prediction:
        now = Ekf._expect(self, kind, pose, states)
        first = kind.table.states(self._first, kind.places)
        of_pose = np.broadcast_to(pose_D_motion(self._first[:POSE]), (len(first), POSE, 3))
        N = np.concatenate([of_pose, kind.table.model.m_D_motion(first)], axis=1)
        J = unobserving(np.concatenate([now.z_D_pose, now.z_D_m], axis=2), N)
        return now._replace(z_D_pose=J[..., :POSE], z_D_m=J[..., POSE:])
