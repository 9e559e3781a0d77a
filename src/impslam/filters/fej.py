"""The first-estimates Jacobian EKF for SLAM (Huang, Mourikis & Roumeliotis 2008, 2010).

A rigid motion of robot and map is unobservable. The textbook EKF evaluates each Jacobian at the newest
estimate, so that the unobservable directions differ from step to step, and it gains information along them.
Here every Jacobian is evaluated at the first estimate of a variable, which never changes: the initial state
of a landmark, and the predicted pose before its correction. The innovations still use the newest estimates.

    prediction:  F = d(pose')/d(pose) between the *predicted* poses, [I, J (p' - p_predicted)],
    correction:  H at the predicted pose and the first states of the landmarks,
    extension:   a new landmark depends on the predicted pose.

The drawback is that the Jacobians keep the errors of the first estimates: with poor first observations the
filter is worse than one with the symmetry in its coordinates (`riekf`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import PrivateAttr

from impslam.component import register
from impslam.filters.atlas import Table
from impslam.filters.belief import POSE
from impslam.filters.ekf import Ekf
from impslam.filters.matched_scan import MatchedKind
from impslam.filters.symmetry import pose_D_motion
from impslam.geometry.se2 import block_rotation, compose
from impslam.landmarks.base import Initial, LandmarkModel, Prediction
from impslam.types import Array, Increment, Observation


@register("fej")
class FirstEstimatesEkf(Ekf):
    """The EKF with Jacobians at first estimates, which keep the unobservable directions constant."""

    _first: Array = PrivateAttr()
    """(n,) the predicted pose and the landmarks' initial states."""
    _first_before: Array = PrivateAttr()
    """The predicted pose (3,) before the last one."""

    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Start with a new state; see `Filter.start`."""
        super().start(pose, covariance, models)
        self._first = self.pose

    def predict(self, increment: Increment) -> None:
        """Move the robot, with F = d(pose')/d(pose) between the predicted poses."""
        belief, before = self._belief, self.pose
        errors = self._systematic(increment)
        self._first = np.append(self._first, belief.mean[len(self._first) : belief.n])
        predicted = self._first[:POSE]
        self._before, self._first_before = belief.moving_entries(), predicted.copy()
        after = compose(before, self._learned_motion(increment, errors))
        V = block_rotation(float(before[2]))
        noise = V @ self._noise(increment) @ V.T
        belief.move(predicted[1] - after[1], after[0] - predicted[0], noise)
        self._add_systematic(increment, float(before[2]), errors)
        belief.mean[:POSE] = self._first[:POSE] = after

    def undo_predict(self) -> None:
        """Undo the last prediction; see `Filter.undo_predict`."""
        super().undo_predict()
        self._first[:POSE] = self._first_before

    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add landmarks, and store their initial states."""
        ids = super().extend(observations, stamp)
        new = self._belief.mean[len(self._first) : self._belief.n]
        self._first = np.concatenate([self._first, new])
        return ids

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks out."""
        if ids:
            remaining = self._atlas.remove(ids, self._belief.n)
            self._belief.keep(remaining)
            self._first = self._first[remaining]

    def _expect(self, kind: MatchedKind, pose: Array, states: Array) -> Prediction:
        now = super()._expect(kind, pose, states)
        table = kind.table
        first = table.model.predict(self._first[:POSE], table.states(self._first, kind.places))
        return now._replace(z_D_pose=first.z_D_pose, z_D_m=first.z_D_m)

    def _initialise(self, table: Table, observation: Observation) -> Initial:
        new = super()._initialise(table, observation)
        m_D_pose = table.model.m_D_motion(new.m[None])[0] @ pose_D_motion(-self._first[:POSE])
        return replace(new, m_D_pose=m_D_pose)
