"""What a correction looks at: the matched landmarks of a scan, kind by kind, in columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.filters.atlas import Pairs, Table
from impslam.filters.belief import POSE
from impslam.filters.columns import Columns
from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

_POSE = np.arange(POSE)


@kernel
def _layout(shapes: Ints) -> tuple[Ints, Ints]:
    """Return `slots` and `blocks` of `Rows` for sights of shapes (s, 3): k, dim_z and dim."""
    total = 0
    for k, dz, _ in shapes:
        total += k * dz
    slots, blocks = np.empty(total, np.int64), np.empty(total, np.int64)
    q, row = POSE, 0
    for k, dz, dim in shapes:
        for _ in range(k):
            slots[row : row + dz], blocks[row : row + dz] = q, row
            q, row = q + dim, row + dz
    return slots, blocks


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """k matched landmarks of one kind: `places` (k,) in their table, and the prior's estimates.

    z (k, dim_z) is what is seen; `pose` (3,) and `states` (k, dim) are where pose and landmarks are
    thought to be before the correction.
    """

    table: Table
    places: Ints | list[int]
    z: Array
    pose: Array
    states: Array


class Scene:
    """All that is seen at once; rows of H and entries of the state stand in the sights' order.

    Attributes
    ----------
    sights : one for each kind
    entries : (q,) indices into the state: the pose, then each matched landmark
    slots, blocks, noise, errors, h_error : see `Rows`
    order : (rows,) indices of the rows that put them in the order of the matches
    """

    def __init__(
        self,
        mean: Array,
        pairs: Iterable[Pairs],
        known: Mapping[str, int],
        doubt: Array | None = None,
    ) -> None:
        """Look at pairs from a mean; R counts `doubt` (matches,) times.

        `known` is where in the state the error stands that a sensor's observations share.
        """
        self.pose = mean[:POSE].copy()
        self.sights: list[Sight] = []
        entries, noise, shapes = [_POSE], [], []
        errors, shared = [], []
        self._which: list[list[int]] = []
        for table, places, seen, rows, which in pairs:
            columns, z, R = (
                table.columns.take(places, 0),
                seen.z.take(rows, 0),
                seen.R.take(rows, 0),
            )
            if known:
                s, whose = _taken_out(R, seen, rows, known)
                errors.append(whose)
                shared.append(s)
            if doubt is not None:
                R *= doubt[which, None, None]
            noise.append(R.reshape(z.size, -1))
            self.sights.append(Sight(table, places, z, self.pose, mean.take(columns)))
            entries.append(columns.ravel())
            shapes.append((*z.shape, columns.shape[1]))
            self._which.append(which)
        self.entries = np.concatenate(entries)
        self.slots, self.blocks = _layout(np.array(shapes))
        self.errors: Ints = np.full(len(self.slots), -1)
        self.h_error = np.zeros(len(self.slots))
        if known:
            offsets, whose = np.array(sorted(known.values())), np.concatenate(errors)
            numbers = len(self.entries) + np.searchsorted(offsets, whose)
            self.entries = np.concatenate([self.entries, offsets])
            self.errors, self.h_error = np.where(whose < 0, -1, numbers), np.concatenate(shared)
        self.noise = stacked(noise)

    @property
    def order(self) -> Ints:
        """Which row is the first of the first match, and so on."""
        sights = zip(self._which, self.sights, strict=True)
        keys = [np.repeat(which, sight.z.shape[1]) for which, sight in sights]
        return np.argsort(np.concatenate(keys), kind="stable")

    @property
    def states(self) -> list[Array]:
        """The landmarks' states (k, dim) of each sight before the correction."""
        return [sight.states for sight in self.sights]

    def moved(self, step: Array) -> tuple[Array, list[Array]]:
        """Return pose and landmarks after a step (q,) in their perturbations."""
        pose = self.pose + step[:POSE]
        pose[2] = wrap(float(pose[2]))
        states, begin = [], POSE
        for sight in self.sights:
            delta = step[begin : begin + sight.states.size].reshape(sight.states.shape)
            states.append(sight.table.model.retract(sight.states, delta))
            begin += sight.states.size
        return pose, states


def _taken_out(
    R: Array, seen: Columns, rows: Sequence[int], known: Mapping[str, int]
) -> tuple[Array, Ints]:
    """Take the part out of R (k, dz, dz) that a known shared error makes.

    Return what each scalar is off by for it (k dz,), and where the error stands (k dz,); -1: none.
    """
    s, whose = seen.shared.take(rows, 0), np.array([known.get(seen.sensors[r], -1) for r in rows])
    s[whose < 0] = 0.0
    R -= s[:, :, None] * s[:, None]
    return s.ravel(), np.repeat(whose, s.shape[1])


def stacked(parts: list[Array]) -> Array:
    """Return arrays (rows, columns) one after another, the narrower filled up with 0."""
    if len(parts) == 1:
        return parts[0]
    out = np.zeros((sum(map(len, parts)), max(part.shape[1] for part in parts)))
    begin = 0
    for part in parts:
        out[begin : begin + len(part), : part.shape[1]] = part
        begin += len(part)
    return out
