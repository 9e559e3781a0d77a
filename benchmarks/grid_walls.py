"""How completely the occupancy grid of a run shows the walls that the run has estimated.

    python benchmarks/grid_walls.py RUN...

RUN is a folder of `imp run`. Each wall longer than 0.5 m is sampled every centimetre, without 10 cm at its
ends. A gap is a sample without an occupied cell within 7.5 cm; the width is the occupied length
across the wall, within 20 cm to both sides.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from impslam.map import Map
from impslam.maps.files import OCCUPIED, MapImage, map_image
from impslam.types import Array, Landmark, Mask

STEP, ENDS, SHORTEST = 0.01, 0.1, 0.5  # m
GAP = 0.0751  # m
OFFSETS = np.arange(-0.2, 0.2 + 1e-9, STEP)  # m, across a wall


def occupied(image: MapImage, points: Array) -> Mask:
    """Return which points (..., 2) m lie in an occupied cell."""
    cells = np.floor((points - image.origin) / image.resolution).astype(int)
    rows, columns = image.pixels.shape
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=-1)
    out = np.zeros(inside.shape, bool)
    out[inside] = image.pixels[::-1][cells[inside, 1], cells[inside, 0]] == OCCUPIED
    return out


def length(wall: Landmark) -> float:
    """Return the distance between the end points of a wall, m."""
    assert wall.end_points is not None
    return float(np.linalg.norm(np.diff(wall.end_points, axis=0)))


def across(image: MapImage, wall: Landmark) -> Mask:
    """Return (samples, offsets) which places along and across a wall are occupied."""
    assert wall.end_points is not None
    first, last = wall.end_points
    along = (last - first) / length(wall)
    t, normal = np.arange(ENDS, length(wall) - ENDS, STEP), np.array([-along[1], along[0]])
    places = first + t[:, None, None] * along + OFFSETS[None, :, None] * normal
    return occupied(image, places)


def main() -> None:
    for run in map(Path, sys.argv[1:]):
        known = Map.load(run / "map.imp")
        image = map_image(known.grid())
        walls = [mark for mark in known.landmarks if mark.kind == "wall"]
        seen = [across(image, wall) for wall in walls if length(wall) > SHORTEST]
        rows = np.concatenate(seen)
        gaps = 1.0 - rows[:, np.abs(OFFSETS) <= GAP].any(axis=1).mean()
        width = 100.0 * STEP * rows.sum(axis=1).mean()
        print(
            f"{run}: {len(seen)} walls, {len(rows) * STEP:.0f} m; gaps {gaps:.1%}, {width:.1f} cm wide"
        )


if __name__ == "__main__":
    main()
