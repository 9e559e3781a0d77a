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

from dataclasses import replace

import numpy as np

from impslam.component import parameter, register
from impslam.filters.belief import POSE
from impslam.filters.ekf import Ekf
from impslam.filters.scene import Sight
from impslam.filters.symmetry import pose_D_motion
from impslam.geometry.kernels import kernel
from impslam.landmarks.base import LandmarkModel, Prediction
from impslam.types import Array, Ints, Landmark


@kernel
def _put_change(A_T: Array, offsets: Ints, m_D_motion: Array) -> None:
    """Enter how m_D_motion (2, k, dim, 3) of landmarks has changed into A^T (3, size)."""
    _, k, dim, _ = m_D_motion.shape
    for i in range(k):
        for c in range(dim):
            for x in range(3):
                A_T[x, offsets[i] + c] = m_D_motion[1, i, c, x] - m_D_motion[0, i, c, x]


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
    """Return L and R (rows + 2 k, n): P - L^T R is P - W W^T, carried on to delta + A xi.

    A^T is (k, n), xi = xi_D_pose delta_pose with xi_D_pose (k, 3); `of_pose` (3, n) are P's first rows.
    The change is A b^T + b A^T with b = cov(delta, xi) + 1/2 A cov(xi), after P - W W^T.
    """
    (rows, n), k = W_T.shape, len(A_T)
    after, b, of_xi = of_pose.copy(), np.zeros((k, n)), np.zeros((k, k))
    _add_product(after, -W_T[:, :POSE].T, W_T)
    _add_product(b, xi_D_pose, after)
    _add_product(of_xi, 0.5 * b[:, :POSE], xi_D_pose.T)
    _add_product(b, of_xi, A_T)
    L, R = np.empty((rows + 2 * k, n)), np.empty((rows + 2 * k, n))
    L[:rows], L[rows : rows + k], L[rows + k :] = W_T, A_T, b
    R[:rows], R[rows : rows + k], R[rows + k :] = W_T, -b, -A_T
    return L, R


@kernel
def _carried_back(z_D_pose: Array, z_D_m: Array, A_pose: Array, A_m: Array, xi: Array) -> Array:
    """Return z_D_pose + (z_D_pose A_pose + z_D_m A_m) xi, (k, dim_z, 3)."""
    k, dz, dim = z_D_m.shape
    out, row = z_D_pose.copy(), np.empty(POSE)
    for i in range(k):
        for a in range(dz):
            for x in range(POSE):
                row[x] = 0.0
                for p in range(POSE):
                    row[x] += z_D_pose[i, a, p] * A_pose[p, x]
                for p in range(dim):
                    row[x] += z_D_m[i, a, p] * A_m[1, i, p, x] - z_D_m[i, a, p] * A_m[0, i, p, x]
            for p in range(POSE):
                for x in range(POSE):
                    out[i, a, p] += row[x] * xi[x, p]
    return out


def _of_both(model: LandmarkModel, old: Array, new: Array) -> Array:
    """Return m_D_motion (2, k, dim, 3) of landmarks at two states (k, dim)."""
    return model.m_D_motion(np.concatenate([old, new])).reshape(2, *old.shape, 3)


def _arc(with_heading: Array) -> Array:
    """Return the mean square (2, 2) of the way from tangent to arc, given cov(place, theta)."""
    x, y = with_heading.tolist()
    return 0.75 * np.array([[y * y, -x * y], [-x * y, x * x]])


@register("riekf")
class RightInvariantEkf(Ekf):
    """The right-invariant EKF: it cannot learn which way the map lies from looking at it."""

    iterations: int = parameter(
        4, "1", "linearisations of a correction at most; the second brings it to millimetres", ge=1
    )

    def _finish(self, W_T: Array, step: Array, of_pose: Array) -> None:
        """Correct, and carry the covariance over to the new state in the same pass over P."""
        before, A_T = self.pose, np.zeros_like(of_pose)
        for table, old, new in self._retract(step):
            _put_change(A_T, table.offsets, _of_both(table.model, old, new))
        A_T[:, :POSE] = (pose_D_motion(self.pose) - pose_D_motion(before)).T
        changed = A_T.any(axis=1)  # points alone leave only the heading's
        xi_D_pose = pose_D_motion(-before)[changed]
        self._belief.subtract(*factors(W_T, A_T[changed], xi_D_pose, of_pose))

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

    def _expect(self, sight: Sight, pose: Array, states: Array) -> Prediction:
        """Return what is seen; Jacobians in the perturbations before the correction, P's own."""
        now = super()._expect(sight, pose, states)
        if pose is sight.pose:
            return now
        A_pose = pose_D_motion(pose) - pose_D_motion(sight.pose)
        A_m = _of_both(sight.table.model, sight.states, states)
        back = pose_D_motion(-sight.pose)
        return replace(now, z_D_pose=_carried_back(now.z_D_pose, now.z_D_m, A_pose, A_m, back))
