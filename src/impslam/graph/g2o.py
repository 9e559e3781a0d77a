"""Pose graphs in the plane as .g2o files (Kuemmerle et al. 2011): VERTEX_SE2, EDGE_SE2 and FIX.

A vertex is `VERTEX_SE2 id x y theta`; an edge `EDGE_SE2 i j x y theta` and the upper triangle of its
information by rows, xx xy xt yy yt tt; `FIX id ...` fixes vertices. Ids may be any distinct integers.

The error in this format is that of Z^-1 T_i_j, in the axes of the measured frame j; ours is in the axes of
frame i. So information is rotated by the measured heading when reading and writing, and chi-squares agree
with other programs.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.errors import SourceError
from impslam.geometry.se2 import rotation
from impslam.types import Array, Edges, Ints

_UPPER = np.triu_indices(3)


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


def read_g2o(path: Path) -> G2o:
    """Return the graph of a file; raise `SourceError` with the line if it cannot be used."""
    vertices: dict[int, list[float]] = {}
    edges: list[tuple[int, int, list[float], int]] = []
    fixed: list[tuple[int, int]] = []
    try:
        lines = path.read_bytes().decode("ascii", "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        try:
            match words:
                case ["VERTEX_SE2", name, *rest]:
                    _add_vertex(vertices, int(name), _numbers(rest, 3))
                case ["EDGE_SE2", first, second, *rest]:
                    edges.append((int(first), int(second), _numbers(rest, 9), number))
                case ["FIX", *names]:
                    fixed += [(int(name), number) for name in names]
                case [str(tag), *_]:
                    _check_comment(tag)
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: {error}") from None
    return _assembled(path, vertices, edges, fixed)


def _check_comment(tag: str) -> None:
    if not tag.startswith("#"):
        raise ValueError(f"{tag[:40]!r} is not VERTEX_SE2, EDGE_SE2 or FIX")


def _numbers(words: list[str], count: int) -> list[float]:
    if len(words) != count:
        raise ValueError(f"{len(words)} numbers after the ids; expected {count}")
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    return values


def _add_vertex(vertices: dict[int, list[float]], name: int, pose: list[float]) -> None:
    if name in vertices:
        raise ValueError(f"vertex {name} occurs twice")
    if not abs(name) < 2**63:
        raise ValueError("the id of a vertex has more than 64 bits")
    vertices[name] = pose


def _assembled(
    path: Path,
    vertices: dict[int, list[float]],
    edges: list[tuple[int, int, list[float], int]],
    fixed: list[tuple[int, int]],
) -> G2o:
    if not vertices:
        raise SourceError(f"{path}: no VERTEX_SE2; this is not a pose graph in the plane")
    rows = {name: row for row, name in enumerate(vertices)}
    named = [(name, line) for i, j, _, line in edges for name in (i, j)] + fixed
    for name, line in named:
        if name not in rows:
            raise SourceError(f"{path}, line {line}: there is no vertex {name}")
    for i, j, _, line in edges:
        if i == j:
            raise SourceError(f"{path}, line {line}: an edge joins vertex {i} to itself")
    values = np.array([row for _, _, row, _ in edges]).reshape(-1, 9)
    information = np.zeros((len(edges), 3, 3))
    information[:, _UPPER[0], _UPPER[1]] = information[:, _UPPER[1], _UPPER[0]] = values[:, 3:]
    information = _rotated(information, values[:, 2])
    ends = np.array([(rows[i], rows[j]) for i, j, _, _ in edges], np.int64).reshape(-1, 2)
    return G2o(
        np.array(list(vertices), np.int64),
        np.array(list(vertices.values())),
        Edges(
            ends[:, 0], ends[:, 1], values[:, :3].copy(), information, np.full(len(edges), np.inf)
        ),
        np.array([rows[name] for name, _ in fixed], np.int64),
    )


def _rotated(information: Array, angles: Array) -> Array:
    """Return information (e, 3, 3) in axes rotated clockwise by `angles` (e,), rad."""
    B = np.zeros((len(angles), 3, 3))
    B[:, :2, :2], B[:, 2, 2] = rotation(angles), 1.0
    return B @ information @ B.transpose(0, 2, 1)


def write_g2o(path: Path, graph: G2o) -> None:
    """Write a graph, without its kernels.

    Poses and measurements are read back exactly, information up to rounding.
    """
    names = graph.ids.tolist()
    lines = [
        f"VERTEX_SE2 {name} {_words(pose)}"
        for name, pose in zip(names, graph.poses.tolist(), strict=True)
    ]
    lines += [f"FIX {names[row]}" for row in graph.fixed.tolist()]
    i, j, T_i_j, information, _ = graph.edges
    upper = _rotated(information, -T_i_j[:, 2])[:, _UPPER[0], _UPPER[1]]
    values = np.concatenate([T_i_j, upper], axis=1).tolist()
    lines += [
        f"EDGE_SE2 {names[a]} {names[b]} {_words(row)}"
        for a, b, row in zip(i.tolist(), j.tolist(), values, strict=True)
    ]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
