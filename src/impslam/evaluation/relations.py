"""Relation errors: an estimate against manually verified relations between poses.

Kümmerle et al. 2009, "On measuring the accuracy of SLAM algorithms", Eq. 5: errors of relative poses need
no alignment, and an early error does not affect the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.trajectory import Statistics, statistics
from impslam.evaluation.tum import read_numbers
from impslam.geometry.se2 import between
from impslam.types import Array, Ints

SLACK = 0.3
"""s between a relation's stamp and the nearest pose: more than the period of the lidars in the suite, whose
relations refer to single scans."""


@dataclass(frozen=True, slots=True, eq=False)
class RelationErrors:
    """Translation (m) and rotation (rad) errors (n,); relations without a pose are `missing`."""

    translation: Array
    rotation: Array
    missing: int

    @property
    def metres(self) -> Statistics:
        """Statistics of the translation errors, m."""
        return statistics(self.translation)

    @property
    def radians(self) -> Statistics:
        """Statistics of the rotation errors, rad."""
        return statistics(self.rotation)


def read_relations(path: Path) -> Array:
    """Return rows (n, 5): two stamps and the planar pose of the second seen from the first.

    Raises
    ------
    ImpError
        If the file is missing, empty, or a line is not a relation.
    """
    rows = np.array(list(read_numbers(path, 8, "stamp1 stamp2 x y z roll pitch yaw")))
    if len(rows) == 0:
        raise ImpError(f"{path}: contains no relation; check that it is a .relations file")
    return rows[:, [0, 1, 2, 3, 7]]


def relation_errors(trajectory: Array, relations: Array) -> RelationErrors:
    """Compare a trajectory (n, 4) with relations (k, 5).

    Raises
    ------
    ImpError
        If no relation has both its poses.
    """
    rows = trajectory[np.argsort(trajectory[:, 0], kind="stable")]
    first, gap_first = _nearest(rows[:, 0], relations[:, 0])
    second, gap_second = _nearest(rows[:, 0], relations[:, 1])
    found = (gap_first <= SLACK) & (gap_second <= SLACK)
    if not found.any():
        raise ImpError(
            "no relation is within the trajectory's time; check that both are of the same log"
        )
    estimate = between(rows[first[found], 1:], rows[second[found], 1:])
    error = between(relations[found, 2:], estimate)
    missing = int(np.sum(~found))
    return RelationErrors(np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2]), missing)


def _nearest(known: Array, stamps: Array) -> tuple[Ints, Array]:
    after = np.clip(np.searchsorted(known, stamps), min(1, len(known) - 1), len(known) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(known[after] - stamps) < np.abs(known[before] - stamps)
    index = np.where(nearer, after, before)
    return index, np.abs(known[index] - stamps)
