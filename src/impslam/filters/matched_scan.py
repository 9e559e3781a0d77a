"""Inputs of a correction: the matched landmarks of a scan, by kind, in columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from impslam.filters.atlas import LandmarkPairs, Table
from impslam.filters.belief import POSE
from impslam.filters.columns import ObservationColumns
from impslam.geometry.angles import wrap
from impslam.types import Array, Ints

_POSE = np.arange(POSE)


class MatchedKind(NamedTuple):
    """k matched landmarks of one kind: `places` (k,) in their table, and the prior's estimates.

    `pose` (3,) and `states` (k, dim) are the estimates before the correction.
    """

    table: Table
    places: Ints
    pose: Array
    states: Array


class MatchedScan:
    """All matches of a scan; rows of H and entries of the state are in the order of the kinds.

    Attributes
    ----------
    kinds, seen : one for each kind, and z (k, dim_z) and R (k, dim_z, dim_z) of the same
    entries : (q,) indices into the state: the pose, each matched landmark, the common errors
    rows : number of observed scalars
    moving : number of entries that a correction changes: all but the common errors
    order : (rows,) indices of the rows in the order of the matches
    """

    def __init__(
        self,
        mean: Array,
        pairs: Iterable[LandmarkPairs],
        known: Mapping[str, int],
        factors: Array | None = None,
    ) -> None:
        """Prepare pairs at a mean, with R multiplied by `factors` (matches,).

        `known` are the indices in the state of the sensors' common errors.
        """
        self.pose = mean[:POSE].copy()
        self.kinds: list[MatchedKind] = []
        self.seen: list[tuple[Array, Array]] = []
        self._which: list[list[int]] = []
        self._error_jacobians: list[Array] = []
        entries = [_POSE]
        for table, places, seen, rows, which in pairs:
            columns = table.columns.take(places, 0)
            z, R = seen.z.take(rows, 0), seen.R.take(rows, 0)
            if known:
                self._error_jacobians.append(_remove_common_errors(R, seen, rows, known))
            if factors is not None:
                R *= factors[which, None, None]
            self.kinds.append(MatchedKind(table, places, self.pose, mean[columns]))
            self.seen.append((z, R))
            self._which.append(which)
            entries.append(columns.reshape(-1))
        self.entries = np.concatenate(entries)
        self.rows, self.moving = sum(z.size for z, _ in self.seen), len(self.entries)
        if known:
            self.entries = np.concatenate([self.entries, list(known.values())])

    def system(self) -> tuple[Array, Array, Array]:
        """Return H (rows, q), R (rows, rows) and nu (rows,), zero except H of the common errors."""
        H, R = np.zeros((self.rows, len(self.entries))), np.zeros((self.rows, self.rows))
        if self._error_jacobians:
            H[:, self.moving :] = np.concatenate(self._error_jacobians)
        return H, R, np.zeros(self.rows)

    @property
    def order(self) -> Ints:
        """Indices of the rows in the order of the matches."""
        seen = zip(self._which, self.seen, strict=True)
        keys = [np.repeat(which, z.shape[1]) for which, (z, _) in seen]
        return np.argsort(np.concatenate(keys), kind="stable")

    @property
    def states(self) -> list[Array]:
        """The landmarks' states (k, dim) of each kind before the correction."""
        return [kind.states for kind in self.kinds]

    def moved(self, step: Array) -> tuple[Array, list[Array]]:
        """Return pose and landmarks after a step (q,) in their perturbations."""
        pose = self.pose + step[:POSE]
        pose[2] = wrap(float(pose[2]))
        states, begin = [], POSE
        for kind in self.kinds:
            delta = step[begin : begin + kind.states.size].reshape(kind.states.shape)
            states.append(kind.table.model.retract(kind.states, delta))
            begin += kind.states.size
        return pose, states


def _remove_common_errors(
    R: Array, seen: ObservationColumns, rows: Ints, known: Mapping[str, int]
) -> Array:
    """Subtract the contribution of known common errors from R (k, dz, dz).

    Return the error (k dz, errors) of each scalar per standard deviation of each common error.
    """
    own = np.array([[seen.sensors[row] == sensor for sensor in known] for row in rows])
    jacobian = seen.shared[rows][:, :, None] * own[:, None]
    R -= jacobian @ jacobian.swapaxes(1, 2)
    by_scalar: Array = jacobian.reshape(-1, len(known))
    return by_scalar
