"""Writes a map's grid, pose graph, landmarks and path for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np

from impslam.evaluation.tum import HEALTH_COLUMN, PATH_COLUMNS, write_tum
from impslam.graph.g2o import G2o, write_g2o
from impslam.health import Reasons
from impslam.map import UPPER, Map
from impslam.maps.files import UNKNOWN, MapImage, write_map
from impslam.maps.landmark_table import write_landmarks
from impslam.types import Array

GRAPH = "graph.g2o"
MAP_FILES = frozenset(
    {"trajectory.tum", "trajectory.csv", "landmarks.csv", "map.pgm", "map.yaml", GRAPH}
)
"""The files written; the graph and the grid only if the map has them."""


Attempt: TypeAlias = Callable[..., AbstractContextManager[None]]
"""Called with the names of files; returns the context in which they are written."""


@contextmanager
def stop_at_error(*names: str) -> Iterator[None]:
    """Let an error of writing a file propagate."""
    del names
    yield


def write_map_files(
    folder: Path,
    known: Map,
    image: MapImage,
    attempt: Attempt = stop_at_error,
    states: Reasons | None = None,
) -> None:
    """Write `MAP_FILES` to an existing folder; `image` is the map's grid.

    `states` (m,) is the health of the newest m sweeps, if known; earlier ones count as TRACKING.
    """
    rows = known.rows()
    with attempt("trajectory.tum"):
        write_tum(folder / "trajectory.tum", np.column_stack((rows.stamps, rows.poses)))
    with attempt("trajectory.csv"):
        if states is not None:
            states = states[known.placed()[len(known.stamps) - len(states) :]]
        table = folder / "trajectory.csv"
        write_path_table(table, rows.stamps, rows.poses, rows.covariances, states)
    with attempt("landmarks.csv"):
        write_landmarks(folder / "landmarks.csv", known.landmarks)
    if len(known.edges.i):
        with attempt(GRAPH):
            write_g2o(folder / GRAPH, _graph(known))
    if (image.pixels != UNKNOWN).any():  # a sensor without scans gives no grid
        with attempt("map.pgm", "map.yaml"):
            write_map(folder, image)


def _graph(known: Map) -> G2o:
    """Return the graph of the keyframes that have edges, with final poses and ids."""
    edges = known.edges
    ids, ends = np.unique(np.concatenate([edges.i, edges.j]), return_inverse=True)
    i, j = ends.reshape(2, -1)
    first = np.zeros(1, np.int64)  # fixed, because the map's origin is arbitrary
    return G2o(ids, known.keyframes.poses[ids], edges._replace(i=i, j=j), first)


_ROW = "%.9f,%.9f,%.9f,%.9f" + 6 * ",%.9e"


def write_path_table(
    path: Path, stamps: Array, poses: Array, covariances: Array, states: Reasons | None = None
) -> None:
    """Write poses (m, 3) with their covariances as CSV, and the health of the newest ones if known."""
    spread = covariances[:, UPPER[0], UPPER[1]]
    values, head, row = np.column_stack((stamps, poses, spread)), PATH_COLUMNS, _ROW
    if states is not None:
        column = np.zeros(len(values))
        column[len(values) - len(states) :] = states
        values = np.column_stack((values, column))
        head = f"{head},{HEALTH_COLUMN}"
        row = row + ",%d"
    with path.open("w", encoding="utf-8") as stream:
        stream.write(head + "\n")
        for begin in range(0, len(values), 1000):  # Python floats take four times the memory
            part = values[begin : begin + 1000]
            stream.write(f"{row}\n" * len(part) % tuple(part.ravel().tolist()))
