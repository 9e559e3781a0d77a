"""What a correction looks at: the matched landmarks of a scan, kind by kind, in columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from impslam.filters.atlas import Table
from impslam.filters.belief import POSE
from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Match, Observation

_POSE = np.arange(POSE)


@kernel
def _repeated(first: int, step: int, k: int, times: int) -> Ints:
    """Return first, first + step, ..., k of them, each so many times."""
    out = np.empty(k * times, np.int64)
    for i in range(k):
        out[i * times : (i + 1) * times] = first + i * step
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """k matched landmarks of one kind: `places` (k,) in their table, and the prior's estimates.

    z (k, dim_z) is what is seen; `pose` (3,) and `states` (k, dim) are where pose and landmarks are
    thought to be before the correction.
    """

    table: Table
    places: Ints
    z: Array
    pose: Array
    states: Array


class Scene:
    """All that is seen at once; rows of H and entries of the state stand in the sights' order.

    Attributes
    ----------
    sights : one for each kind
    entries : (q,) indices into the state: the pose, then each matched landmark
    slots, blocks, noise : see `Rows`
    order : (rows,) indices of the rows that put them in the order of the matches
    """

    def __init__(
        self,
        mean: Array,
        groups: Iterable[tuple[Table, Ints, Ints]],
        observations: Sequence[Observation],
        matches: Sequence[Match],
    ) -> None:
        self.pose = mean[:POSE].copy()
        self.sights: list[Sight] = []
        entries, slots, blocks, noise = [_POSE], [], [], []
        self._which: list[Ints] = []
        q, row = POSE, 0
        for table, places, which in groups:
            seen = [observations[matches[i].observation] for i in which.tolist()]
            columns, k = table.columns[places], len(seen)
            z = np.concatenate([o.z for o in seen]).reshape(k, -1)
            noise.append(np.concatenate([o.R for o in seen]))
            self.sights.append(Sight(table, places, z, self.pose, mean[columns]))
            entries.append(columns.ravel())
            slots.append(_repeated(q, columns.shape[1], k, z.shape[1]))
            blocks.append(_repeated(row, z.shape[1], k, z.shape[1]))
            self._which.append(which)
            q, row = q + columns.size, row + z.size
        self.entries = np.concatenate(entries)
        self.slots, self.blocks, self.noise = stacked(slots), stacked(blocks), stacked(noise)

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


T = TypeVar("T", np.float64, np.int64)


def stacked(parts: list[npt.NDArray[T]]) -> npt.NDArray[T]:
    """Return arrays (rows, columns) or (rows,) one after another, the narrower filled up with 0."""
    if len(parts) == 1:
        return parts[0]
    if parts[0].ndim == 1:
        return np.concatenate(parts)
    out = np.zeros((sum(map(len, parts)), max(part.shape[1] for part in parts)), parts[0].dtype)
    begin = 0
    for part in parts:
        out[begin : begin + len(part), : part.shape[1]] = part
        begin += len(part)
    return out
