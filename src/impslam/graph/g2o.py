"""Write pose graphs in the plane as .g2o files (Kuemmerle et al. 2011): VERTEX_SE2, EDGE_SE2 and FIX.

A vertex is `VERTEX_SE2 id x y theta`; an edge `EDGE_SE2 i j x y theta` and the upper triangle of its
information by rows, xx xy xt yy yt tt; `FIX id ...` fixes vertices. Ids may be any distinct integers.

The error in this format is that of Z^-1 T_i_j, in the axes of the measured frame j; ours is in the axes of
frame i. So information is rotated by the measured heading, and chi-squares agree with other programs.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.geometry.se2 import rotation
from impslam.types import Array, Edges, Ints

UPPER = np.triu_indices(3)  # of the entries in a line


class G2o(NamedTuple):
    """The contents of a .g2o file.

    Attributes
    ----------
    ids : (n,) of the vertices, in order of the file
    poses : (n, 3)
    edges : between rows of `poses`, all with a quadratic kernel
    fixed : (k,) rows of `poses`; may be empty
    """

    ids: Ints
    poses: Array
    edges: Edges
    fixed: Ints


def rotated(information: Array, angles: Array) -> Array:
    """Return information (e, 3, 3) in axes rotated clockwise by `angles` (e,), rad."""
    B = np.zeros((len(angles), 3, 3))
    B[:, :2, :2], B[:, 2, 2] = rotation(angles), 1.0
    return B @ information @ B.transpose(0, 2, 1)


def write_g2o(path: Path, graph: G2o) -> None:
    """Write a graph, without its kernels.

    Poses and measurements are written exactly, information up to rounding.
    """
    names = graph.ids.tolist()
    lines = [
        f"VERTEX_SE2 {name} {_words(pose)}"
        for name, pose in zip(names, graph.poses.tolist(), strict=True)
    ]
    lines += [f"FIX {names[row]}" for row in graph.fixed.tolist()]
    i, j, T_i_j, information, _ = graph.edges
    upper = rotated(information, -T_i_j[:, 2])[:, UPPER[0], UPPER[1]]
    values = np.concatenate([T_i_j, upper], axis=1).tolist()
    lines += [
        f"EDGE_SE2 {names[a]} {names[b]} {_words(row)}"
        for a, b, row in zip(i.tolist(), j.tolist(), values, strict=True)
    ]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
