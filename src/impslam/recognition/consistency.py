"""Pairwise consistency of loop closures (Mangelson et al. 2018, Eq. 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import GATE_3D_99
from impslam.geometry.se2 import compose_uncertain
from impslam.types import Array

GATE = GATE_3D_99
"""Squared Mahalanobis distance that 1 % of true pairs exceed, and are rejected."""


class Relation(NamedTuple):
    """A relative pose (3,), `T_a_b`, and the covariance (3, 3) of its additive error."""

    pose: Array
    covariance: Array


def distance2(one: Relation, other: Relation, references: Relation, queries: Relation) -> float:
    """Return the squared Mahalanobis distance by which two closures disagree.

    `T_a_b` is one closure, `T_c_d` the other. There are two paths from a to d: over b, by `T_a_b` and the
    chain of queries `T_b_d`; over c, by the chain of references `T_a_c` and `T_c_d`. Closures and chains
    have independent errors, so the covariance of the difference is the sum of those of both paths. The
    covariance of a chain may be zero; that of a closure must not.
    """
    over_b, P = compose_uncertain(*one, *queries)
    over_c, Q = compose_uncertain(*references, *other)
    error = over_b - over_c
    error[2] = wrap(float(error[2]))
    return float(error @ np.linalg.solve(P + Q, error))


def consistent(one: Relation, other: Relation, references: Relation, queries: Relation) -> bool:
    """Return whether closures `T_a_b` and `T_c_d` agree, given the chains `T_a_c` and `T_b_d`."""
    return distance2(one, other, references, queries) <= GATE
