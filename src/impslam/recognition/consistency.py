"""Whether two closures can both be true (Mangelson et al. 2018, pairwise consistency, Eq. 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose_uncertain
from impslam.types import Array

GATE = 11.345  # chi^2 of 3 degrees of freedom: one true pair in a hundred is refused


class Relation(NamedTuple):
    """A pose (3,), `T_a_b`, and the covariance (3, 3) of an additive error on it."""

    pose: Array
    covariance: Array


def distance2(one: Relation, other: Relation, references: Relation, queries: Relation) -> float:
    """Return the squared Mahalanobis distance by which two closures disagree.

    `T_a_b` is the one closure, `T_c_d` the other. From a to d there are two ways: over b, `T_a_b`
    and the chain of queries `T_b_d`; over c, the chain of references `T_a_c` and `T_c_d`. Closures and
    chains have independent errors, so the difference has the sum of the two ways' covariances. A chain
    of no length has no covariance; a closure must have one.
    """
    over_b, P = compose_uncertain(*one, *queries)
    over_c, Q = compose_uncertain(*references, *other)
    error = over_b - over_c
    error[2] = wrap(float(error[2]))
    return float(error @ np.linalg.solve(P + Q, error))


def consistent(
    one: Relation, other: Relation, references: Relation, queries: Relation, gate: float = GATE
) -> bool:
    """Tell whether two closures, `T_a_b` and `T_c_d`, agree through the chains `T_a_c` and `T_b_d`."""
    return distance2(one, other, references, queries) <= gate
