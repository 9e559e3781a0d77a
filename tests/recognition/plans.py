"""Buildings made of walls, and what a robot sees on its way through them."""

import numpy as np
from tests.extractors.scans import cast, regular_angles, room

from impslam.geometry.se2 import compose
from impslam.recognition.submap import Submap, gather, view

ANGLES = regular_angles(361, 2.0 * np.pi * 0.75)
REFERENCE_CELL, QUERY_CELL = 0.05, 0.1


def walls(*lines):
    """Return (w, 2, 2) from x0, y0, x1, y1."""
    return np.array(lines, float).reshape(-1, 2, 2)


OFFICE = np.concatenate([
    room(-8.0, 9.0, -5.0, 6.0),
    walls(
        [-8, 1, -3, 1], [-2, 1, 3, 1], [4.2, 1, 9, 1],  # the corridor's upper side
        [-8, -1.5, -5, -1.5], [-4, -1.5, 1, -1.5], [2, -1.5, 9, -1.5],  # and its lower side
        [-4, 1, -4, 6], [1.5, 1, 1.5, 4], [5.5, 1, 5.5, 6], [-1, -1.5, -1, -5], [4, -1.5, 4, -4],
        [-7, 3, -6, 3.4], [-6, 3.4, -6, 4.5], [7, 3, 8, 3.2], [-5.5, -3.5, -4.2, -3.2],
    ),
])  # fmt: skip
CORRIDOR = np.concatenate([room(-40.0, 40.0, -1.0, 1.0)])


def place(plan, truth, frame, cell, *, circles=None, noise=0.01, seed=0, seen=None, angles=ANGLES):
    """Return the submap of a plan seen from true poses (k, 3), in the frame (3,)."""
    rng = np.random.default_rng(seed)
    scans = [
        cast(plan, circles, pose=pose, angles=angles, noise=noise, range_max=20.0, rng=rng).scan
        for pose in truth
    ]
    return gather([view(s) for s in scans], truth if seen is None else seen, frame, cell)


def way(x0, y0, x1, y1, n=8):
    """Return n poses (n, 3) on a straight line, heading along it."""
    return np.column_stack([
        np.linspace(x0, x1, n), np.linspace(y0, y1, n), np.full(n, np.arctan2(y1 - y0, x1 - x0))
    ])  # fmt: skip


def moved(submap, T):
    """Return a submap as seen from a frame in which its own lies at T (3,)."""
    c, s = np.cos(T[2]), np.sin(T[2])
    R, rows = np.array([[c, -s], [s, c]]), submap.features.copy()
    rows[:, :2] = rows[:, :2] @ R.T + T[:2]
    rows[:, 2:4] = rows[:, 2:4] @ R.T
    return Submap(rows, compose(T, submap.vantages), submap.free)
