"""The extended Kalman filter for SLAM (thesis Eq. 2.22-2.29; Smith, Self & Cheeseman 1990).

The state is the pose `T_map_base` [x, y, theta], perturbed by addition, and every landmark in the
perturbation of its own model. A scan is processed as one batch: all matched landmarks are predicted at the
same mean, at which the Jacobians are also evaluated (the thesis prints x(k-1) in Eq. 2.20; the predicted
state is meant). With more than one iteration, a correction with a large turn is relinearised about its own
result, i.e. Gauss-Newton on the posterior (Bell & Cathey 1993).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Hypotheses
from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.filters.atlas import Atlas, Table
from impslam.filters.base import Filter, Reach, everything
from impslam.filters.belief import POSE, GaussianBelief, rows_of
from impslam.filters.gaussian import INDEFINITE, GaussianFilter
from impslam.filters.matched_scan import MatchedKind, MatchedScan
from impslam.filters.scoring import angle_mask, score
from impslam.filters.update import among, gain, innovation_covariance, put_rows, solve
from impslam.geometry.angles import wrap
from impslam.geometry.kernels import plain
from impslam.geometry.se2 import rotation
from impslam.landmarks.base import Initial, LandmarkModel, Prediction
from impslam.types import Array, ErrorEstimate, Increment, Innovation, Ints, Match, Observation

_NONE: Ints = np.empty(0, np.int64)
_ODOMETRY = "odometry "
"""Prefix of the names of its errors; a number follows."""


@register("ekf")
class Ekf(GaussianFilter):
    """The textbook EKF over pose and landmarks, written for speed."""

    follows: ClassVar[bool] = True
    considers_shared_errors: ClassVar[bool] = True
    iterations: int = parameter(
        1, "1", "linearisations of a correction, each about the last result (1: textbook EKF)", ge=1
    )
    tolerance: float = parameter(
        1e-3, "rad", "no further linearisation if the heading changes by less than this", gt=0
    )
    _belief: GaussianBelief = PrivateAttr()
    _before: tuple[Ints, Array, Array] = PrivateAttr()
    """The entries that the last prediction changed, before it."""

    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Start with a new state; see `Filter.start`."""
        self._belief = GaussianBelief(pose, covariance)
        self._atlas = Atlas(models)

    def resembles(self, other: Filter, share: float) -> bool:
        """Compare means one by one, and the order of landmarks; see `Filter.resembles`."""
        if not isinstance(other, Ekf) or self._belief.n != other._belief.n:
            return False
        n = self._belief.n
        sigma = np.sqrt(self._belief.P.diagonal()[:n])
        difference = self._belief.mean[:n] - other._belief.mean[:n]
        difference[2] = wrap(float(difference[2]))
        for table in self._atlas.tables():
            states, others = table.states(self._belief.mean), table.states(other._belief.mean)
            difference[table.columns] = table.model.difference(states, others)
        return bool((np.abs(difference) <= share * sigma).all())

    def predict(self, increment: Increment) -> None:
        """Predict the pose: x' = x (+) u, P' = F P F^T + V Q V^T (thesis Eq. 2.23-2.26)."""
        heading, errors = float(self._belief.mean[2]), self._systematic(increment)
        self._before = self._belief.moving_entries()
        self._belief.drive(self._learned_motion(increment, errors), self._noise(increment))
        self._add_systematic(increment, heading, errors)

    def _noise(self, increment: Increment) -> Array:
        """Return the covariance (3, 3) of the independent part of the error."""
        return increment.random if self.considers_shared_errors else increment.covariance

    def _systematic(self, increment: Increment) -> Ints:
        """Return the indices (k,) of the systematic errors in the state; new ones are added."""
        if increment.systematic is None or not self.considers_shared_errors:
            return _NONE
        each = enumerate(increment.systematic.learned.tolist())
        return np.array(
            [self._belief.error(f"{_ODOMETRY}{k}", learned=learned) for k, learned in each]
        )

    def _learned_motion(self, increment: Increment, errors: Ints) -> Array:
        """Return the motion (3,) corrected by the errors that are learned, after renewing these."""
        if not len(errors) or increment.systematic is None:
            return increment.d_pose
        self._belief.renew(errors, increment.systematic.correlation)
        return increment.d_pose + increment.systematic.errors @ self._belief.mean[errors]

    def _add_systematic(self, increment: Increment, heading: float, errors: Ints) -> None:
        """Add the systematic errors of a motion from a heading to the error of the pose."""
        if len(errors) and increment.systematic is not None:
            S = increment.systematic.errors.copy()
            S[:2] = rotation(heading) @ S[:2]
            self._belief.shift(errors, S)

    @property
    def systematic_errors(self) -> ErrorEstimate | None:
        """What is known of the systematic errors of odometry; see `Filter.systematic_errors`."""
        belief = self._belief
        entries = [entry for name, entry in belief.errors.items() if name.startswith(_ODOMETRY)]
        if not entries:
            return None
        return ErrorEstimate(belief.mean[entries], np.sqrt(belief.P.diagonal()[entries]))

    def undo_predict(self) -> None:
        """Undo the last prediction; see `Filter.undo_predict`."""
        self._belief.restore(self._before)

    def hypothesise(
        self, observations: Sequence[Observation], reach: Reach = everything
    ) -> list[Hypotheses]:
        """Score the pairings of observations with landmarks of their kind, within a gate."""
        return [
            score(self._belief, table, seen, reach(table.model.dim_z))
            for table, seen in self._atlas.by_kind(observations)
        ]

    def joint(
        self, observations: Sequence[Observation], pairs: Sequence[Match]
    ) -> tuple[Array, Array]:
        """Return innovation and S = H P H^T + R of all pairs, including their correlations."""
        scan = MatchedScan(
            self._belief.mean, self._atlas.pairs(observations, pairs), self._belief.errors
        )
        H, R, innovation = self._linearise(scan, scan.pose, scan.states)
        S = innovation_covariance(H, among(self._belief.P, scan.entries), R)
        return innovation[scan.order], S[np.ix_(scan.order, scan.order)]

    def correct(
        self, observations: Sequence[Observation], matches: Sequence[Match]
    ) -> Innovation | None:
        """Correct by all matches of a scan in one batch (thesis Eq. 2.27-2.29).

        The linearisations only need P of the pose and the matched landmarks. After convergence, the gain is
        applied to the whole state. The returned innovation is that of the first linearisation; if R is
        inflated (`dof`, `repeats`), it is None, because it would be for another noise.
        """
        if not matches:
            return None
        belief, pairs = self._belief, self._atlas.pairs(observations, matches)
        factors = self.noise_factors(matches)
        scan, innovation = MatchedScan(belief.mean, pairs, belief.errors, factors), None
        pose, states = scan.pose, scan.states
        step = np.zeros(len(scan.entries))
        for iteration in range(self.iterations):
            if iteration:
                pose, states = scan.moved(step)
            system = self._linearise(scan, pose, states)
            G, moved, (nis, log_det) = solve(system, belief.P, scan.entries, scan.moving, step)
            if math.isnan(log_det):
                raise NumericalError(INDEFINITE)
            if innovation is None and factors is None:
                innovation = Innovation(nis, scan.rows, log_det)
            turned, step = abs(moved[2] - step[2]), moved
            if turned < self.tolerance:
                break
        self._finish(*gain(belief.P, belief.n, scan.entries, G))
        return innovation

    def _finish(self, W_T: Array, step: Array, of_pose: Array) -> None:
        """Move the mean by a step (n,) and correct the covariance by W^T (rows, n).

        `of_pose` (3, n) are P's rows of the pose before the correction.
        """
        del of_pose
        self._retract(step)
        self._belief.subtract(W_T)

    def follow(self, pose: Array, landmarks: Mapping[int, Array]) -> None:
        """Move the mean, with the covariance in the coordinates of this filter; see `Filter.follow`."""
        if not self.follows:
            super().follow(pose, landmarks)
        mean, n = self._belief.mean, self._belief.n
        step = np.zeros(n)
        step[:POSE] = pose - mean[:POSE]
        step[2] = wrap(float(step[2]))
        for table in self._atlas.tables():
            states = np.array([landmarks[number] for number in table.ids.tolist()])
            step[table.columns] = table.model.difference(table.states(mean), states)
        self._finish(np.zeros((1, n)), step, rows_of(self._belief.P, np.arange(POSE), n))

    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add landmarks with their full cross-covariance to pose and map."""
        ids = []
        for observation in observations:
            table = self._atlas.table(observation.kind)
            new = self._initialise(table, observation)
            R, on, J = observation.R, np.arange(POSE), new.m_D_pose
            if observation.shared is not None:
                R = R - np.outer(observation.shared, observation.shared)
                on = np.append(on, self._belief.error(observation.sensor))
                # the landmark is at z minus the error
                J = np.column_stack([J, -new.m_D_z @ observation.shared])
            noise = new.m_D_z @ R @ new.m_D_z.T + new.slack
            offset = self._belief.append(new.m, on, J, noise)
            ids.append(self._atlas.add(self.pose, observation, offset, new.m, stamp))
        return tuple(ids)

    def difference(self, one: int, other: int) -> tuple[Array, Array] | None:
        """Return the difference of two landmarks of a kind as observed, and its covariance."""
        difference, entries, J = self._difference(one, other)
        return difference, J @ among(self._belief.P, entries) @ J.T

    def fuse(self, kept: int, gone: int) -> None:
        """Correct by a difference of zero without noise, and remove one; see `Filter.fuse`."""
        belief = self._belief
        difference, entries, J = self._difference(kept, gone)
        P_rows = rows_of(belief.P, entries, belief.n)
        HP = J @ P_rows
        try:
            L = np.linalg.cholesky(HP[:, entries] @ J.T)
        except np.linalg.LinAlgError:
            raise NumericalError(
                f"the difference of landmarks {kept} and {gone} is singular"
            ) from None
        W_T = np.linalg.solve(L, HP)
        self._finish(W_T, -np.linalg.solve(L, difference) @ W_T, P_rows[:POSE])
        self._atlas.join(belief.mean, kept, gone)
        self.remove([gone])

    def _difference(self, one: int, other: int) -> tuple[Array, Ints, Array]:
        """Return the difference (dim_z,) of the second of two landmarks to the first, as observed.

        Also return the indices (q,) of the pose and both in the state, and the Jacobian (dim_z, q). The
        difference is invariant to a common motion, so it adds no information on unobservable directions.
        """
        table, places = self._atlas.of((one, other))
        pose, states = self.pose, table.states(self._belief.mean, places)
        seen = self._expect(MatchedKind(table, places, pose, states), pose, states)
        J = np.hstack([seen.z_D_pose[1] - seen.z_D_pose[0], -seen.z_D_m[0], seen.z_D_m[1]])
        entries = np.concatenate([np.arange(POSE), table.columns[places].ravel()])
        return table.model.residual(seen.z[1], seen.z[0]), entries, J

    def _linearise(
        self, scan: MatchedScan, pose: Array, states: list[Array]
    ) -> tuple[Array, Array, Array]:
        """Return H, R and nu at estimates of the pose (3,) and of each kind's landmarks."""
        system, row, entry = scan.system(), 0, POSE
        for kind, seen, m in zip(scan.kinds, scan.seen, states, strict=True):
            z, z_D_pose, z_D_m = self._expect(kind, pose, m)
            predicted = plain(z), plain(z_D_pose), plain(z_D_m)
            put_rows(system, (row, entry), seen, predicted, angle_mask(type(kind.table.model)))
            row, entry = row + seen[0].size, entry + m.size
        return system

    def _expect(self, kind: MatchedKind, pose: Array, states: Array) -> Prediction:
        """Return predicted observations and Jacobians at the estimates of a correction."""
        return kind.table.model.predict(pose, states)

    def _initialise(self, table: Table, observation: Observation) -> Initial:
        """Return the new landmark of an observation, with Jacobians at the newest estimate."""
        return table.model.initialise(self.pose, observation)

    def _retract(self, step: Array) -> None:
        """Move the mean by a step in the perturbations of pose and landmarks."""
        mean = self._move_pose(step)
        for table in self._atlas.tables():
            states = table.model.retract(table.states(mean), table.states(step))
            mean[table.columns] = states

    def _move_pose(self, step: Array) -> Array:
        """Move the pose and what is learned of errors by a step (n,); return the mean."""
        mean = self._belief.mean
        mean[:POSE] += step[:POSE]
        mean[2] = wrap(float(mean[2]))
        self._belief.learn(step)
        return mean
