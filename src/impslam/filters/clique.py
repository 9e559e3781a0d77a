"""A joint Gaussian of a few variables, and the propagation of updates of some of them to the others.

Let a clique contain the joint of S and R, and let later observations depend on R only through S. Then
p(R | S) is still valid after the joint of S has changed to mean s' and covariance P'_SS:

    K = P_RS P_SS^-1,    r' = r + K (s' - s),    P'_RS = K P'_SS,    P'_RR = P_RR - K P_RS^T + K P'_SS K^T

(Lauritzen 1992; Pinies & Tardos 2008, Eq. 15-17). Variables outside the clique are not involved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.geometry.scipy_extension import load
from impslam.types import Array, Ints

dtrsm = load("scipy.linalg._fblas", "scipy.linalg.blas").dtrsm
_DETERMINED = 1e-13  # of a variance: a smaller rest is rounding, and other variables determine it


def _determined(P_SS: Array, P_SR: Array) -> tuple[Array, Array]:
    """Return `regression` if some of S are determined by previous ones; both arguments are overwritten.

    An example is a pose after a motion without noise. By a generalised inverse, the rest does not depend on
    such variables.
    """
    least, K_T = _DETERMINED * P_SS.diagonal(), np.zeros(P_SR.shape)
    known = []
    for j in range(len(P_SS)):
        if not P_SS[j, j] > least[j]:
            P_SR[j] = 0.0
            continue
        known.append(j)
        root = np.sqrt(P_SS[j, j])
        P_SS[j, j:] /= root
        P_SR[j] /= root
        P_SS[j + 1 :, j + 1 :] -= np.outer(P_SS[j, j + 1 :], P_SS[j, j + 1 :])
        P_SR[j + 1 :] -= np.outer(P_SS[j, j + 1 :], P_SR[j])
    for j in reversed(known):
        K_T[j] = (P_SR[j] - P_SS[j, j + 1 :] @ K_T[j + 1 :]) / P_SS[j, j]
    return K_T, P_SR


def regression(P_SS: Array, P_RS: Array) -> tuple[Array, Array]:
    """Return K^T = P_SS^-1 P_SR (s, r) and V (s, r) with V^T V = K P_SR; P_RS (r, s) is overwritten."""
    try:
        L = np.linalg.cholesky(P_SS)
    except np.linalg.LinAlgError:
        return _determined(P_SS, P_RS.T.copy())
    if (np.square(L.diagonal()) < _DETERMINED * P_SS.diagonal()).any():
        return _determined(P_SS, P_RS.T.copy())
    V = dtrsm(1.0, L.T, P_RS.T, trans_a=1, overwrite_b=1)
    return dtrsm(1.0, L.T, V), V


@dataclass(frozen=True, slots=True, eq=False)
class Clique:
    """The joint Gaussian of scalars identified by `codes` (n,): mean (n,), P (n, n)."""

    codes: Ints
    mean: Array
    P: Array

    @classmethod
    def empty(cls) -> Clique:
        """Return a clique without variables."""
        return cls(np.empty(0, np.int64), np.empty(0), np.empty((0, 0)))

    def places(self, codes: Ints) -> Ints:
        """Return the indices (k,) of scalars of this clique."""
        order = np.argsort(self.codes)
        return order[np.searchsorted(self.codes, codes, sorter=order)]

    def marginal(self, codes: Ints) -> Clique:
        """Return the joint of some of the scalars (k,)."""
        at = self.places(codes)
        return Clique(codes, self.mean[at], self.P.take(at, 0).take(at, 1))

    def absorbed(self, newer: Clique, carried: Ints) -> Clique:
        """Return this clique updated by a neighbour's, with the scalars `carried` (k,) of that added."""
        common = _both(self.codes, newer.codes)
        new = carried[~np.isin(carried, common)]
        fresh = newer.marginal(np.concatenate([common, new]))
        rest = self.codes[~np.isin(self.codes, common)]
        return fresh.extended(self, rest) if len(rest) else fresh

    def extended(self, older: Clique, rest: Ints) -> Clique:
        """Return this clique with scalars (k,) of a neighbour, whose common scalars are less up to date."""
        common = _both(older.codes, self.codes)
        own, S, R = self.places(common), older.places(common), older.places(rest)
        of_S, of_R = older.P.take(S, 0), older.P.take(R, 0)
        K_T, V = regression(of_S.take(S, 1), of_R.take(S, 1))
        n, k = len(self.codes), len(rest)
        P = np.empty((n + k, n + k))
        P[:n, :n], P[n:, :n] = self.P, K_T.T @ self.P.take(own, 0)
        P[:n, n:] = P[n:, :n].T
        of_rest = of_R.take(R, 1) - V.T @ V + P[n:, :n].take(own, 1) @ K_T
        P[n:, n:] = 0.5 * (of_rest + of_rest.T)  # asymmetric rounding errors would grow
        mean = older.mean[R] + (self.mean[own] - older.mean[S]) @ K_T
        codes = np.concatenate([self.codes, rest])
        return Clique(codes, np.concatenate([self.mean, mean]), P)


def _both(one: Ints, other: Ints) -> Ints:
    """Return the common codes (k,)."""
    return one[np.isin(one, other)]
