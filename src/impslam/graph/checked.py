"""Validation of a pose graph, and conversion for kernels."""

from __future__ import annotations

import numpy as np

from impslam.errors import NumericalError
from impslam.geometry.kernels import plain
from impslam.types import Array, Edges, Ints, Mask, check_shape


def check_edges(edges: Edges) -> None:
    """Raise `ShapeError` if the columns of edges differ in length or have other shapes."""
    e = len(edges.i)
    check_shape("edges.j", edges.j, e)
    check_shape("edges.T_i_j", edges.T_i_j, e, 3)
    check_shape("edges.information", edges.information, e, 3, 3)
    check_shape("edges.kernel", edges.kernel, e)


def checked(poses: Array, edges: Edges, fixed: Ints) -> tuple[Array, Edges, Mask]:
    """Return arrays for kernels, with `fixed` as a mask; raise `NumericalError` if they are unusable."""
    poses = plain(poses)
    check_shape("poses", poses, None, 3)
    i, j = (np.require(ends, np.int64, ["C", "W"]) for ends in (edges.i, edges.j))
    n = len(poses)
    edges = Edges(i, j, plain(edges.T_i_j), plain(edges.information), plain(edges.kernel))
    check_edges(edges)
    fixed = np.asarray(fixed, np.int64)
    for what, indices in (("an edge", i), ("an edge", j), ("`fixed`", fixed)):
        if indices.size and not 0 <= indices.min() <= indices.max() < n:
            raise NumericalError(f"pose graph: {what} names a pose that is not in 0 to {n - 1}")
    for name, rows in (("pose", poses), ("edge", edges.T_i_j), ("edge", edges.information)):
        if not np.isfinite(rows).all():
            bad = int(np.flatnonzero(~np.isfinite(rows.reshape(len(rows), -1)).all(1))[0])
            raise NumericalError(f"pose graph: {name} {bad} is not finite")
    if not (edges.kernel > 0.0).all():
        raise NumericalError("pose graph: the scale of a robust kernel is not positive")
    if (i == j).any():
        bad = int(np.argmax(i == j))
        raise NumericalError(f"pose graph: edge {bad} joins pose {i[bad]} to itself")
    is_fixed = np.zeros(n, np.bool_)
    is_fixed[fixed] = True
    return poses, edges, is_fixed
