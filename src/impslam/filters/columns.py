"""Observations of one scan as columns by kind, shared by all steps of a filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.types import Array, Ints, Observation


class ObservationColumns(NamedTuple):
    """The k observations of one kind.

    Attributes
    ----------
    indices : (k,) into all observations of the scan
    z, R : (k, dim_z) and (k, dim_z, dim_z)
    ends : (k, 2, 2) m, end points in base_link; 0 for points
    shared : (k, dim_z) error of z per standard deviation of its sensor's common error, or 0
    sensors : the sensors with that error, "" for none
    """

    indices: Ints
    z: Array
    R: Array
    ends: Array
    shared: Array
    sensors: list[str]

    @classmethod
    def of(cls, observations: Sequence[Observation], indices: list[int]) -> ObservationColumns:
        """Return the columns of the observations at these indices, all of one kind."""
        some, k = [observations[i] for i in indices], len(indices)
        z = np.concatenate([o.z for o in some]).reshape(k, -1)
        R = np.concatenate([o.R for o in some]).reshape(*z.shape, -1)
        sensors, shared = [""] * k, np.zeros(z.shape)
        for row, o in enumerate(some):
            if o.shared is not None:
                shared[row], sensors[row] = o.shared, o.sensor
        return cls(np.array(indices), z, R, end_points(some), shared, sensors)


NONE = ObservationColumns(
    np.empty(0, np.int64),
    np.empty((0, 0)),
    np.empty((0, 0, 0)),
    np.empty((0, 2, 2)),
    np.empty((0, 0)),
    [],
)
"""Columns of a kind that is not in the scan."""


def end_points(observations: Sequence[Observation]) -> Array:
    """Return the end points (k, 2, 2) m of observations in base_link; 0 for points."""
    out = np.zeros((len(observations), 2, 2))
    for row, o in enumerate(observations):
        if o.end_points is not None:
            out[row] = o.end_points
    return out


class ScanColumns:
    """All observations of a scan.

    Attributes
    ----------
    kinds : columns by kind, in the order of their first observations
    rows : row of each observation in the columns of its kind
    """

    def __init__(self, observations: Sequence[Observation]) -> None:
        kinds: dict[str, list[int]] = {}
        self.rows: list[int] = []
        for i, observation in enumerate(observations):
            same = kinds.setdefault(observation.kind, [])
            self.rows.append(len(same))
            same.append(i)
        self.kinds = {
            kind: ObservationColumns.of(observations, some) for kind, some in kinds.items()
        }
