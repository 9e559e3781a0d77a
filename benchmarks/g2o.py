"""Read pose graphs in the plane from .g2o files; see `impslam.graph.g2o` for the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from impslam.errors import SourceError
from impslam.graph.g2o import UPPER, G2o, rotated
from impslam.types import Edges


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
    information[:, UPPER[0], UPPER[1]] = information[:, UPPER[1], UPPER[0]] = values[:, 3:]
    information = rotated(information, values[:, 2])
    ends = np.array([(rows[i], rows[j]) for i, j, _, _ in edges], np.int64).reshape(-1, 2)
    return G2o(
        np.array(list(vertices), np.int64),
        np.array(list(vertices.values())),
        Edges(
            ends[:, 0], ends[:, 1], values[:, :3].copy(), information, np.full(len(edges), np.inf)
        ),
        np.array([rows[name] for name, _ in fixed], np.int64),
    )
