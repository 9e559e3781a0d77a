"""The pairs of a scan and their joint innovation, in the order in which JCBB searches them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from impslam.association.branch_and_bound import NONE, search
from impslam.geometry.chi_square import quantile, quantiles
from impslam.types import Array, Ints, Mask

T = TypeVar("T", np.int64, np.float64)


class PairSet(NamedTuple):
    """Some pairs of a system, as indices (k,), and their d^2 + log det S."""

    pairs: Ints
    score: float


class PairColumns(NamedTuple):
    """Columns of p pairs of an observation and a landmark: ids, dim_z, and log det R (p,)."""

    ids: Ints
    dims: Ints
    observations: Ints
    landmarks: Ints
    noise: Array

    def take(self, pairs: Ints) -> PairColumns:
        """Return some of the pairs."""
        ids, dims, observations, landmarks, noise = self
        return PairColumns(
            ids[pairs], dims[pairs], observations[pairs], landmarks[pairs], noise[pairs]
        )

    @property
    def starts(self) -> Ints:
        """The first row of each pair, and the end of the last one (p + 1,)."""
        return _starts(self.dims)

    def rows(self, pairs: Ints) -> Ints:
        """Return the rows of some pairs, in the order of these."""
        dims = self.dims[pairs]
        return np.arange(dims.sum()) + np.repeat(self.starts[pairs] - _starts(dims)[:-1], dims)

    def blocks(self) -> Iterator[tuple[Ints, Ints]]:
        """Yield the pairs (k,) of each dimension, and their rows (k, dim)."""
        for dim in set(self.dims.tolist()):
            pairs = np.flatnonzero(self.dims == dim)
            yield pairs, self.starts[pairs, None] + np.arange(dim)

    @property
    def conflicts(self) -> Ints:
        """How many other pairs have the same observation or landmark (p,)."""
        of_observation, of_landmark = map(np.bincount, (self.observations, self.landmarks))
        return np.asarray(of_observation[self.observations] + of_landmark[self.landmarks] - 2)


class JointSystem:
    """The covariance S (rows, rows) of the innovation (rows,) of p pairs, given some others.

    Attributes
    ----------
    columns : of the pairs
    dof, distance2 : number of rows and d^2 of the pairs that are given
    """

    def __init__(
        self,
        columns: PairColumns,
        innovation: Array,
        S: Array,
        dof: int = 0,
        distance2: float = 0.0,
    ) -> None:
        self.columns, self._innovation, self._S = columns, innovation, S
        self.dof, self.distance2 = dof, distance2

    def __len__(self) -> int:
        return len(self.columns.ids)

    def take(self, pairs: Ints) -> JointSystem:
        """Return the system of some pairs, in their order."""
        rows = self.columns.rows(pairs)
        S, nu = self._S[np.ix_(rows, rows)], self._innovation[rows]
        return JointSystem(self.columns.take(pairs), nu, S, self.dof, self.distance2)

    def first(self, count: int) -> Ints:
        """Return the pairs of the first observations, of `count` at most."""
        observations = self.columns.observations
        return np.flatnonzero(
            np.append(0, np.cumsum(observations[1:] != observations[:-1])) < count
        )

    def given(self, chosen: Ints, rest: Ints, gate: float) -> JointSystem:
        """Return the pairs of the rest that pass the gate, each alone, given that the chosen ones are true.

        The innovations are jointly normal: given nu_c of the chosen pairs, nu_r has the mean
        S_rc S_cc^-1 nu_c and the covariance S_rr - S_rc S_cc^-1 S_cr. The result is in the order of the
        search: by observation, first those whose pairs have the fewest conflicts, of these the likeliest.
        That order depends on scores, not on the order of the observations.
        """
        columns, S = self.columns.take(rest), self._S
        c, r = self.columns.rows(chosen), self.columns.rows(rest)
        nu_c, S_cr = self._innovation[c], S[np.ix_(c, r)]
        gain = np.linalg.solve(S[np.ix_(c, c)], np.column_stack([S_cr, nu_c]))
        gain, weighted = gain[:, :-1], gain[:, -1]
        nu = self._innovation[r] - weighted @ S_cr
        distance2, cost = np.empty((2, len(rest)))
        inside = np.empty(len(rest), np.bool_)
        for pairs, rows in columns.blocks():
            of_chosen = np.einsum("cpa,cpb->pab", S_cr[:, rows], gain[:, rows])
            block = S[r[rows][:, :, None], r[rows][:, None]] - of_chosen
            distance2[pairs], log_det = _scores(block, nu[rows])
            cost[pairs] = distance2[pairs] + log_det
            inside[pairs] = distance2[pairs] < quantile(gate, rows.shape[1])
        order = _order(columns, cost, inside)
        k = columns.rows(order)
        S_k = S[np.ix_(r[k], r[k])] - S_cr[:, k].T @ gain[:, k]
        dof, past = self.dof + len(c), self.distance2 + float(nu_c @ weighted)
        return JointSystem(columns.take(order), nu[k], S_k, dof, past)

    def search(self, gate: float, budget: int, beat: tuple[int, float] = (0, np.inf)) -> PairSet:
        """Return the best set that passes the gate with the pairs that are given.

        It is empty if no set beats a number of pairs and a score.
        """
        columns = self.columns
        observations = columns.observations
        changes = np.flatnonzero(observations[1:] != observations[:-1]) + 1
        groups = np.concatenate([[0], changes, [len(self)]])
        rest = _remaining(columns.dims[groups[:-1]])
        limits = quantiles(gate, self.dof + int(rest[0]))[self.dof :] - self.distance2
        chosen, score, _ = search(
            (self._S, self._innovation),
            (columns.starts, columns.landmarks),
            groups,
            (rest, _remaining(columns.noise[groups[:-1]])),
            limits,
            budget,
            beat,
        )
        return PairSet(chosen[chosen != NONE], score)

    def costs_given_others(self, chosen: Ints) -> Array:
        """Return d^2 + log det S of each of the chosen pairs, given all others.

        With P = S^-1 of the chosen pairs, the innovation of a pair has the conditional covariance
        P_pp^-1 and the conditional mean error P_pp^-1 (P nu)_p.
        """
        rows, costs = self.columns.rows(chosen), np.empty(len(chosen))
        P = np.asarray(np.linalg.inv(self._S[np.ix_(rows, rows)]), float)
        pull = P @ self._innovation[rows]
        for pairs, of_pair in self.columns.take(chosen).blocks():
            distance2, log_det = _scores(P[of_pair[:, :, None], of_pair[:, None]], pull[of_pair])
            costs[pairs] = distance2 - log_det
        return costs


def _scores(S: Array, nu: Array) -> tuple[Array, Array]:
    """Return d^2 and log det S of innovations (k, dim) of covariance (k, dim, dim)."""
    weighted = np.linalg.solve(S, nu[..., None])[..., 0]
    return np.einsum("pi,pi->p", nu, weighted), np.linalg.slogdet(S)[1]


def _order(columns: PairColumns, cost: Array, inside: Mask) -> Ints:
    """Return the pairs inside the gate in the order of the search; see `JointSystem.given`."""
    pairs = np.flatnonzero(inside)
    columns, cost = columns.take(pairs), cost[pairs]
    of_pair = columns.observations
    least = np.full(of_pair.max(initial=0) + 1, np.inf)
    np.minimum.at(least, of_pair, cost)
    conflicts = np.bincount(of_pair, columns.conflicts)
    return pairs[np.lexsort((cost, of_pair, least[of_pair], conflicts[of_pair]))]


def _starts(sizes: Ints) -> Ints:
    """Return the start of each of several consecutive blocks, and the end of the last one."""
    starts = np.zeros(len(sizes) + 1, np.int64)
    np.add.accumulate(sizes, out=starts[1:])
    return starts


def _remaining(values: npt.NDArray[T]) -> npt.NDArray[T]:
    """Return the sums of the values from each index to the end, followed by 0."""
    return np.append(values, values[:1] * 0)[::-1].cumsum()[::-1]
