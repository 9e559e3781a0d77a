"""The unscented Kalman filter for SLAM, in square-root form (Julier & Uhlmann 1997; van der Merwe 2001).

The state is x [+] S u with u of unit covariance and `[+]` the perturbations of pose and landmarks: additive
for the pose [x, y, theta], in its own frame for a wall. A function of it is evaluated at sigma points,
+-sqrt(3) along each column of S (n + kappa = 3, which matches a Gaussian's fourth moment). With a_j and b_j
the odd and even parts of the function's change along column j,

    mean = f(x) + 1/3 sum b_j,    slopes a_j / sqrt(3),
    covariance = 1/3 sum a_j a_j^T + 2/9 sum b_j b_j^T.

The mean is that of Julier and Uhlmann; the covariance is that of Nørgaard, Poulsen & Ravn 2000, which
cannot become negative, unlike the former with its negative centre weight for n > 3. Both agree, and are
exact to the fourth moment, if the function is nonlinear in only one column, as in the heading, which has
the first column of S to itself.

An observation depends only on the pose and its landmark, so 3 + dim columns suffice: those of the pose,
with which the landmark is correlated, and dim for the landmark given the pose. The slopes over them are a
linear regression with the residual 2/9 sum b_j b_j^T as noise (Lefebvre, Bruyninckx & De Schutter 2002). So
a scan costs O(n^2), as with the EKF (Huang, Mourikis & Roumeliotis 2013), without sigma points of the whole
state.

The unobservable directions are not constant in these coordinates, as in those of the textbook EKF: with
large heading errors, `riekf` is the consistent filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Hypotheses
from impslam.component import register
from impslam.errors import NumericalError
from impslam.filters.atlas import Atlas, LandmarkPairs, Table
from impslam.filters.base import Reach, everything
from impslam.filters.belief import POSE
from impslam.filters.gaussian import INDEFINITE, GaussianFilter
from impslam.filters.scoring import score_predicted
from impslam.filters.square_root import SquareRootBelief, expand_columns, own_roots
from impslam.geometry.angles import wrap
from impslam.geometry.roots import root
from impslam.geometry.se2 import compose
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Increment, Ints, Match, Observation

SPREAD = math.sqrt(3.0)


class Unscented(NamedTuple):
    """Unscented transform of a function's changes at sigma points.

    Attributes
    ----------
    shift : (..., d) of the mean from the value at the centre
    slopes : (..., d, c) over the columns
    bends : (..., d, c), a root of the residual's covariance
    """

    shift: Array
    slopes: Array
    bends: Array

    @classmethod
    def of(cls, changes: Array) -> Unscented:
        """Return the transform of changes (2 c, ..., d) at all positive points, then all negative ones."""
        plus, minus = np.moveaxis(changes.reshape(2, -1, *changes.shape[1:]), 1, -1)
        even = 0.5 * (plus + minus)
        bends = math.sqrt(2.0) / 3.0 * even
        return cls(even.sum(-1) / 3.0, 0.5 / SPREAD * (plus - minus), bends)


class Expected(NamedTuple):
    """Predicted observations of k landmarks.

    z (k, dz), its slopes (k, dz, 3 + dim) over the columns of pose and landmark, the landmarks' own
    `roots` (k, dim, dim), and the residual's covariance `noise` (k, dz, dz).
    """

    z: Array
    slopes: Array
    roots: Array
    noise: Array


def points(columns: Array) -> Array:
    """Return sigma points' perturbations (2 c, d) from columns (d, c): all positive, then all negative."""
    ahead = SPREAD * columns.T
    return np.concatenate([ahead, -ahead])


@register("ukf")
class UnscentedKalmanFilter(GaussianFilter):
    """The unscented filter in square-root form: no Jacobians, and second-order means."""

    _belief: SquareRootBelief = PrivateAttr()
    _before: SquareRootBelief = PrivateAttr()

    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Start with a new state; see `Filter.start`."""
        self._belief = SquareRootBelief(pose, covariance)
        self._atlas = Atlas(models)

    def predict(self, increment: Increment) -> None:
        """Predict the pose by composing sigma points of pose and motion."""
        belief = self._belief
        self._before = belief.copy()
        spread = np.zeros((2 * POSE, 2 * POSE))
        spread[:POSE, :POSE] = belief.S[:POSE, :POSE]
        spread[POSE:, POSE:] = root(increment.covariance)
        at = points(spread)
        pose = compose(belief.mean[:POSE], increment.d_pose)
        changes = compose(belief.mean[:POSE] + at[:, :POSE], increment.d_pose + at[:, POSE:]) - pose
        changes[:, 2] = at[:, 2] + at[:, POSE + 2]  # beyond half a turn, too
        moved = Unscented.of(changes)
        noise = np.column_stack([moved.slopes[:, POSE:], moved.bends])
        belief.drive(_wrapped(pose + moved.shift), moved.slopes[:, :POSE], noise)

    def undo_predict(self) -> None:
        """Undo the last prediction; see `Filter.undo_predict`."""
        self._belief = self._before

    def hypothesise(
        self, observations: Sequence[Observation], reach: Reach = everything
    ) -> list[Hypotheses]:
        """Score the pairings of observations with landmarks of their kind, within a gate."""
        scores = []
        for table, seen in self._atlas.by_kind(observations):
            expected = self._expect(table, np.arange(len(table.ids)))
            covariance = expected.slopes @ expected.slopes.swapaxes(1, 2) + expected.noise
            gate, known = reach(table.model.dim_z), (expected.z, covariance)
            scores.append(score_predicted(self._belief, table, seen, gate, known))
        return scores

    def joint(
        self, observations: Sequence[Observation], pairs: Sequence[Match]
    ) -> tuple[Array, Array]:
        """Return the innovations of all pairs and their covariance, including correlations."""
        H, innovation, R = self._measured(observations, pairs)
        S = H @ H.T
        begin = 0
        for block in R:
            end = begin + len(block)
            S[begin:end, begin:end] += block
            begin = end
        return innovation, S

    def correct(self, observations: Sequence[Observation], matches: Sequence[Match]) -> None:
        """Correct by all matches of a scan in one batch."""
        if not matches:
            return
        H, y, R = self._measured(observations, matches, self.noise_factors(matches))
        begin = 0
        for block in R:
            rows = slice(begin, begin + len(block))
            whiten = _whitening(block)
            H[rows], y[rows] = whiten @ H[rows], whiten @ y[rows]
            begin = rows.stop
        step, mean = self._belief.absorb(H, y), self._belief.mean
        mean[:POSE] = _wrapped(mean[:POSE] + step[:POSE])
        for table in self._atlas.tables():
            mean[table.columns] = table.model.retract(table.states(mean), table.states(step))

    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add landmarks with their full cross-covariance: sigma points of pose and observation."""
        ids = []
        for observation in observations:
            model = self._atlas.table(observation.kind).model
            new = model.initialise(self.pose, observation)
            spread = np.zeros((POSE + model.dim_z,) * 2)
            spread[:POSE, :POSE] = self._belief.S[:POSE, :POSE]
            spread[POSE:, POSE:] = root(observation.R)
            there = np.array(
                [
                    model.initialise(self.pose + at[:POSE], _moved(observation, at[POSE:])).m
                    for at in points(spread)
                ]
            )
            found = Unscented.of(model.difference(np.broadcast_to(new.m, there.shape), there))
            of_z = np.column_stack([found.slopes[:, POSE:], found.bends])
            m = model.retract(new.m[None], found.shift[None])[0]
            offset = self._belief.extend(m, found.slopes[:, :POSE], of_z @ of_z.T + new.slack)
            ids.append(self._atlas.add(self.pose, observation, offset, m, stamp))
        return tuple(ids)

    def _expect(self, table: Table, places: Ints) -> Expected:
        """Return the predicted observations of some landmarks of a kind."""
        belief, model, offsets = self._belief, table.model, table.offsets[places]
        k, dim = len(offsets), model.dim
        roots = own_roots(belief.S, offsets, dim)
        by_pose = belief.S[table.columns[places], :POSE]
        spread = np.concatenate([by_pose, roots], axis=2)  # (k, dim, 3 + dim)
        ahead = SPREAD * np.moveaxis(spread, 2, 0)
        pose, states = belief.mean[:POSE], table.states(belief.mean, places)
        poses = np.zeros((2, POSE + dim, POSE))
        poses[0, :POSE] = SPREAD * belief.S[:POSE, :POSE].T
        poses[1] = -poses[0]
        m = model.retract(
            np.broadcast_to(states, (2 * (POSE + dim), k, dim)), np.concatenate([ahead, -ahead])
        )
        z = model.observe(pose, states)
        found = Unscented.of(model.residual(model.observe(pose + poses.reshape(-1, POSE), m), z))
        noise = found.bends @ found.bends.swapaxes(1, 2)
        return Expected(z + found.shift, found.slopes, roots, noise)

    def _measured(
        self,
        observations: Sequence[Observation],
        matches: Sequence[Match],
        factors: Array | None = None,
    ) -> tuple[Array, Array, list[Array]]:
        """Return H (rows, n) over u, the innovations (rows,) and R of each, in the matches' order.

        R is multiplied by `factors` (matches,).
        """
        found: dict[int, tuple[Array, Array, Array]] = {}
        for pairs in self._atlas.pairs(observations, matches):
            found.update(self._rows(pairs, factors))
        H, innovation, R = zip(*(found[i] for i in range(len(matches))), strict=True)
        return np.concatenate(H), np.concatenate(innovation), list(R)

    def _rows(
        self, pairs: LandmarkPairs, factors: Array | None
    ) -> dict[int, tuple[Array, Array, Array]]:
        """Return H, innovation and R of the matches of one kind, by their index."""
        table, places, columns, rows, which = pairs
        seen = self._expect(table, places)
        z, R = columns.z[rows], columns.R[rows]
        if factors is not None:
            R = factors[which, None, None] * R
        innovation, R = table.model.residual(z, seen.z), R + seen.noise
        H = np.zeros((len(which), z.shape[1], self._belief.n))
        for k, place in enumerate(places):
            offset = table.offsets[place]
            expand_columns(self._belief.S, offset, seen.roots[k], seen.slopes[k], H[k])
        return {i: (H[k], innovation[k], R[k]) for k, i in enumerate(which)}


def _wrapped(pose: Array) -> Array:
    pose[2] = wrap(float(pose[2]))
    return pose


def _whitening(R: Array) -> Array:
    """Return an A with A R A^T the identity."""
    try:
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(R)))
    except np.linalg.LinAlgError:
        raise NumericalError(INDEFINITE) from None
    if not np.isfinite(whiten).all():  # LAPACK does not fail for NaN
        raise NumericalError(INDEFINITE)
    return whiten


def _moved(observation: Observation, delta: Array) -> Observation:
    return replace(observation, z=observation.z + delta)
