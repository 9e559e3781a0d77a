"""The right-invariant EKF for SLAM (Barrau & Bonnabel 2015; Zhang et al. 2017).

A rigid motion of robot and map is unobservable in its three directions. In the coordinates of the textbook
EKF they are the columns of G(x) = d(state)/d(motion) and depend on the estimate through the lever arms from
the map origin. Each correction changes x, so the unobservable directions change, and the EKF gains spurious
information on the heading (Julier & Uhlmann 2001; Huang, Mourikis & Roumeliotis 2010).

Here the error is (xi, e): xi = [x, y, theta] moves everything, e_i is the remaining error of a landmark,

    T = exp(xi) T^,    m_i = exp(xi) m^_i [+] e_i,

in which the three directions are always xi alone. Zhang et al.'s error of a point is e_i plus the
translation of xi: a constant change of coordinates, which has no effect on an EKF. A wall's e_i is in the
wall's own frame, like its perturbation.

**Additive coordinates.** To first order, the perturbation in the rest of the package is delta = G(x) xi +
(0, e). A prediction changes only the pose; it is exactly that of the EKF, on three rows of P. A correction
moves the state from x to x+ while the covariance of (xi, e) stays, so that of the perturbation becomes that
of

    delta+ = delta + (G(x+) - G(x)) xi,

an update of P of rank two (six with walls): one more pass over half of P for each scan. This is the only
difference to `ekf`. The exponential map would also rotate a correction's translation by half its rotation;
over 400 steps of 3 degrees each this does not change the third digit of any result, so it is left out.

**Second order.** By default, a correction is relinearised about its own result: with a heading error,
positions move along an arc, and a single linearisation estimates them too close, on average. The new
Jacobians are transformed back to the perturbations before the correction, in which P is expressed;
otherwise they would violate the invariance.

The reported covariances of positions are mean squares about the estimate, including the arc. A displacement
delta, to first order, by a heading error theta is accompanied by 1/2 theta J delta, with J a quarter turn:
P + 3/4 (J c) (J c)^T with c = cov(position, theta), since E[theta^4] = 3 var(theta)^2. All positions turn
by the same theta, so this also holds for their joint covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.component import parameter, register
from impslam.filters.belief import POSE
from impslam.filters.ekf import Ekf
from impslam.filters.matched_scan import MatchedKind
from impslam.filters.symmetry import pose_D_motion
from impslam.geometry.kernels import kernel, plain
from impslam.landmarks.base import Prediction
from impslam.types import Array, Ints, Landmark


@kernel
def _enter(columns: Ints, states: tuple[Array, Array], change: tuple[Array, Array]) -> None:
    """Write states (k, dim) to the mean, and the change (k, dim, 3) of their m_D_motion to A^T."""
    (mean, after), (A_T, D) = states, change
    for i in range(len(columns)):
        for c in range(columns.shape[1]):
            mean[columns[i, c]] = after[i, c]
            for x in range(3):
                A_T[x, columns[i, c]] = D[i, c, x]


@kernel
def _add_product(out: Array, A: Array, B: Array) -> None:
    """Add A B to out, row by row, for a small A."""
    for i in range(len(A)):
        for k in range(len(B)):
            a = A[i, k]
            for j in range(B.shape[1]):
                out[i, j] += a * B[k, j]


@kernel
def factors(W_T: Array, A_T: Array, xi_D_pose: Array, of_pose: Array) -> tuple[Array, Array]:
    """Return L and R (rows + 2 k, n): P - L^T R is P - W W^T, transformed to delta + A xi.

    A^T is (3, n), xi = xi_D_pose delta_pose with xi_D_pose (3, 3); `of_pose` (3, n) are P's first rows. k
    rows of A^T are not zero: with points alone, only that of the heading. The change is A b^T + b A^T with
    b = cov(delta, xi) + 1/2 A cov(xi), after P - W W^T.
    """
    rows, n = W_T.shape
    changed = np.array([x for x in range(len(A_T)) if A_T[x].any()], np.int64)
    A, to_xi, k = A_T[changed], xi_D_pose[changed], len(changed)
    L, R = np.empty((rows + 2 * k, n)), np.empty((rows + 2 * k, n))
    L[:rows], R[:rows] = W_T, W_T
    after, b, of_xi = of_pose.copy(), L[rows + k :], np.zeros((k, k))
    b[:] = 0.0
    _add_product(after, -W_T[:, :POSE].T, W_T)
    _add_product(b, to_xi, after)
    _add_product(of_xi, 0.5 * b[:, :POSE], to_xi.T)
    _add_product(b, of_xi, A)
    L[rows : rows + k], R[rows : rows + k], R[rows + k :] = A, -b, -A
    return L, R


@kernel
def _carried_back(
    z_D_pose: Array, z_D_m: Array, poses: tuple[Array, Array], m_D_motion: Array
) -> Array:
    """Return z_D_pose + (z_D_pose A_pose + z_D_m A_m) xi_D_pose, (k, dim_z, 3).

    A is the change of G between two `poses` and from m_D_motion[:k] to [k:] of the landmarks.
    """
    (k, dz, dim), (before, after) = z_D_m.shape, poses
    x, y = before[0], before[1]
    out, row = z_D_pose.copy(), np.empty(POSE)
    for i in range(k):
        for a in range(dz):
            row[:] = 0.0
            row[2] = z_D_pose[i, a, 1] * (after[0] - x) - z_D_pose[i, a, 0] * (after[1] - y)
            for p in range(dim):
                for c in range(POSE):
                    row[c] += z_D_m[i, a, p] * (m_D_motion[k + i, p, c] - m_D_motion[i, p, c])
            out[i, a, 0] += row[0]
            out[i, a, 1] += row[1]
            out[i, a, 2] += row[2] + row[0] * y - row[1] * x
    return out


def _quarter_turned(with_heading: Array) -> Array:
    """Return J c (2,) for c (2,), the covariance of a position with the heading."""
    x, y = with_heading.tolist()
    return np.array([-y, x])


def _arc(turned: Array) -> Array:
    """Return the mean square (d, d) of the offsets from tangent to arc of positions, given J c (d,)."""
    return 0.75 * np.outer(turned, turned)


@register("riekf")
class RightInvariantEkf(Ekf):
    """The right-invariant EKF: it gains no spurious information on the orientation of the map."""

    iterations: int = parameter(
        4,
        "1",
        "maximum linearisations of a correction; the second is accurate to millimetres",
        ge=1,
    )

    def _finish(self, W_T: Array, step: Array, of_pose: Array) -> None:
        """Correct, and transform the covariance to the new state in the same pass over P."""
        before, A_T = self.pose, np.zeros((POSE, len(step)))
        mean = self._move_pose(step)
        for table in self._atlas.tables():
            after, change = table.model.carry(table.states(mean), table.states(step))
            _enter(table.columns, (mean, after), (A_T, change))
        A_T[2, 0], A_T[2, 1] = before[1] - mean[1], mean[0] - before[0]
        self._belief.subtract(*factors(W_T, A_T, pose_D_motion(-before), of_pose))

    @property
    def covariance(self) -> Array:
        """(3, 3) of the pose: mean squares about the estimate, to second order in the heading."""
        P = self._belief.pose_covariance()
        P[:2, :2] += _arc(_quarter_turned(P[:2, 2]))
        return P

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`, with covariances as for the pose."""
        turned = self._turned_places()
        return tuple(
            replace(m, covariance=m.covariance + _arc(turned[m.id])) if m.id in turned else m
            for m in super().landmarks()
        )

    def landmark_covariance(self) -> Array:
        """Return the joint covariance (2 k, 2 k) of the landmarks, with arcs as in `landmarks`."""
        turned = self._turned_places()
        offsets = [turned.get(number, np.zeros(2)) for number in self._atlas.ids().tolist()]
        return super().landmark_covariance() + _arc(np.ravel(offsets))

    def _turned_places(self) -> dict[int, Array]:
        """Return `_quarter_turned` of the landmarks that are positions, by id."""
        P = self._belief.P
        return {
            int(number): _quarter_turned(P[offset : offset + 2, 2])
            for table in self._atlas.tables()
            if table.model.is_place
            for number, offset in zip(table.ids, table.offsets, strict=True)
        }

    def _expect(self, kind: MatchedKind, pose: Array, states: Array) -> Prediction:
        """Return predicted observations, with Jacobians in the perturbations before the correction."""
        now = super()._expect(kind, pose, states)
        if pose is kind.pose:
            return now
        D = kind.table.model.m_D_motion(np.concatenate([kind.states, states]))
        z_D_pose = _carried_back(plain(now.z_D_pose), plain(now.z_D_m), (kind.pose, pose), D)
        return Prediction(now.z, z_D_pose, now.z_D_m)
