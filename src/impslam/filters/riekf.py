"""The right-invariant EKF for SLAM (Barrau & Bonnabel 2015; Zhang et al. 2017).

Robot and map, moved rigidly together, look the same: three directions of the state that nothing
observes. In the coordinates of the textbook EKF they are the columns of G(x) = d(state)/d(motion) and
depend on the estimate through the lever arms from the map origin. Each correction changes x, so what
was unobservable is not quite any more, and out of the mismatch the EKF learns a heading that nothing
tells (Julier & Uhlmann 2001; Huang, Mourikis & Roumeliotis 2010).

Here the error is (xi, e): xi = [x, y, theta] moves everything, e_i is what remains of a landmark's,

    T = exp(xi) T^,    m_i = exp(xi) m^_i [+] e_i,

in which the three directions are xi alone, for ever. Zhang et al.'s error of a point is e_i plus the
translation of xi: a constant change of coordinates, which no EKF notices. A wall's e_i is in the wall's
own frame, as its perturbation is.

**Kept in additive coordinates.** To first order the perturbation that the rest of the package speaks
is delta = G(x) xi + (0, e). A prediction moves the pose alone; it is that of the EKF exactly, three
rows of P and no more. A correction moves the state from x to x+ while (xi, e) keep their covariance, so
that of the perturbation becomes that of

    delta+ = delta + (G(x+) - G(x)) xi,

an update of P of rank two (six with walls): one more pass over half of P for each scan. That alone tells
the filter from `ekf`. The group's exponential would also turn a correction's translation by half its
rotation; over 400 steps at 3 degrees each that changes no figure's third digit, so it is left out.

**Second order.** A correction is linearised again about its own result, by default: places swing
round an arc as a heading errs, and a single linearisation finds them nearer, on average, than they
are. The new Jacobians are carried back to the perturbations before the correction, which P speaks of;
taken as they are they would undo what this filter is for.

The covariances of places that users read are mean squares about the estimate, the arc included. What
moves by delta to first order as the heading errs by theta moves by 1/2 theta J delta more, J a quarter
turn: P + 3/4 (J c) (J c)^T with c = cov(place, theta), since E[theta^4] = 3 var(theta)^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.filters.belief import POSE, GaussianBelief, Rows
from impslam.filters.blas import dsyr2
from impslam.filters.ekf import Ekf
from impslam.filters.symmetry import pose_D_motion, state_D_motion
from impslam.types import Array, Landmark, Match, Observation


def shear(belief: GaussianBelief, A: Array, xi_D_pose: Array) -> None:
    """Change P to that of delta + A xi, in place.

    A is (n, k), and xi = xi_D_pose delta_pose with xi_D_pose (k, 3).
    """
    n, P = belief.n, belief.P
    pose = belief.pose_covariance()
    with_xi = np.concatenate([pose, P[POSE:n, :POSE]]) @ xi_D_pose.T  # cov(delta, xi)
    of_xi = xi_D_pose @ pose @ xi_D_pose.T
    left, right = np.zeros((2, A.shape[1], len(P)))
    left[:, :n], right[:, :n] = A.T, (with_xi + 0.5 * A @ of_xi).T
    # Rank two by rank two: a third of dsyr2k's time for one column, the same for three.
    for a, b in zip(left, right, strict=True):
        P = dsyr2(1.0, a, b, lower=1, a=P, overwrite_a=1)
    belief.P = P


def _arc(with_heading: Array) -> Array:
    """Return the mean square (2, 2) of the way from tangent to arc, given cov(place, theta)."""
    swung = _quarter_turn(with_heading)
    return np.asarray(0.75 * np.outer(swung, swung))


def _quarter_turn(v: Array) -> Array:
    """Return vectors (..., 2) turned left."""
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


@register("riekf")
class RightInvariantEkf(Ekf):
    """The right-invariant EKF: it cannot learn which way the map lies from looking at it."""

    iterations: int = parameter(
        4, "1", "linearisations of a correction at most; the second brings it to millimetres", ge=1
    )
    _prior: tuple[Array, Array] | None = PrivateAttr(default=None)
    """While correcting: G (n, 3) of the state before, and xi_D_pose there, the inverse of G's pose."""

    def correct(self, observations: Sequence[Observation], matches: Sequence[Match]) -> None:
        """Take all matches in, and carry the covariance over to the new state."""
        if not matches:
            return
        self._prior = state_D_motion(self._belief, self._atlas), pose_D_motion(-self.pose)
        try:
            super().correct(observations, matches)
            A, xi_D_pose = self._since_prior()
        finally:
            self._prior = None
        changed = A.any(axis=0)  # points alone leave only the heading's column
        shear(self._belief, A[:, changed], xi_D_pose[changed])

    @property
    def covariance(self) -> Array:
        """(3, 3) of the pose: mean squares about the estimate, to second order in the heading."""
        P = self._belief.pose_covariance()
        P[:2, :2] += _arc(P[:2, 2])
        return P

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the map in the form users read, covariances as for the pose."""
        P = self._belief.P
        arcs = {
            int(number): _arc(P[offset : offset + 2, 2])
            for table in self._atlas.tables()
            if table.model.is_place
            for number, offset in zip(table.ids, table.offsets, strict=True)
        }
        return tuple(
            replace(m, covariance=m.covariance + arcs[m.id]) if m.id in arcs else m
            for m in super().landmarks()
        )

    def _since_prior(self) -> tuple[Array, Array]:
        """Return A (n, 3) and xi_D_pose (3, 3): perturbations now are those before plus A xi."""
        assert self._prior is not None
        before, xi_D_pose = self._prior
        return state_D_motion(self._belief, self._atlas) - before, xi_D_pose

    def _stack(
        self, observations: Sequence[Observation], matches: Sequence[Match]
    ) -> tuple[Rows, Array, Array]:
        """Return `Ekf._stack`, H in the perturbations before the correction that P speaks of."""
        rows, innovation, R = super()._stack(observations, matches)
        if self._prior is not None:
            A, xi_D_pose = self._since_prior()
            H_A = np.array([rows.apply(a) for a in A.T]).T
            rows.h_pose += H_A @ xi_D_pose
        return rows, innovation, R
