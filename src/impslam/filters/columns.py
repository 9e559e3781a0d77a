"""Observations of one scan as columns, kind by kind: made once, read by every step of a filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.types import Array, Ints, Observation


class Columns(NamedTuple):
    """The k observations of one kind.

    Attributes
    ----------
    indices : (k,) into all observations of the scan
    z, R : (k, dim_z) and (k, dim_z, dim_z)
    ends : (k, 2, 2) m, where in base_link they begin and end; 0 for those of points
    shared : (k, dim_z) what z is off by for a standard deviation of its sensor's shared error, or 0
    sensors : whose error that is, "" for none
    """

    indices: Ints
    z: Array
    R: Array
    ends: Array
    shared: Array
    sensors: list[str]

    @classmethod
    def of(cls, observations: Sequence[Observation], indices: list[int]) -> Columns:
        """Return the columns of the observations at these indices, all of one kind."""
        some, k = [observations[i] for i in indices], len(indices)
        z = np.concatenate([o.z for o in some]).reshape(k, -1)
        R = np.concatenate([o.R for o in some]).reshape(*z.shape, -1)
        sensors, shared = [""] * k, np.zeros(z.shape)
        for row, o in enumerate(some):
            if o.shared is not None:
                shared[row], sensors[row] = o.shared, o.sensor
        return cls(np.array(indices), z, R, end_points(some), shared, sensors)


NONE = Columns(
    np.empty(0, np.int64),
    np.empty((0, 0)),
    np.empty((0, 0, 0)),
    np.empty((0, 2, 2)),
    np.empty((0, 0)),
    [],
)
"""Of a kind that the scan does not show."""


def end_points(observations: Sequence[Observation]) -> Array:
    """Return where in base_link observations begin and end (k, 2, 2), m; 0 for those of points."""
    out = np.zeros((len(observations), 2, 2))
    for row, o in enumerate(observations):
        if o.end_points is not None:
            out[row] = o.end_points
    return out


class ScanColumns:
    """All observations of a scan.

    Attributes
    ----------
    kinds : columns by kind, in the order in which the scan shows the kinds
    rows : of each observation, its row in the columns of its kind
    """

    def __init__(self, observations: Sequence[Observation]) -> None:
        kinds: dict[str, list[int]] = {}
        self.rows: list[int] = []
        for i, observation in enumerate(observations):
            same = kinds.setdefault(observation.kind, [])
            self.rows.append(len(same))
            same.append(i)
        self.kinds = {kind: Columns.of(observations, some) for kind, some in kinds.items()}
