"""The interactive map of the report: the scripts in `web`, and the data that they draw.

Columns are base64 of little-endian arrays, prefixed with their type and a colon: browsers decode them
quickly, and they take a third of the size of decimal numbers.
"""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between
from impslam.map import Map
from impslam.maps.files import MapImage
from impslam.observers.accuracy import AlignedTruth
from impslam.observers.base import Outcome
from impslam.observers.canvas import png
from impslam.observers.grid_picture import coarsened
from impslam.observers.history import History, health_of
from impslam.observers.page import packaged, section
from impslam.observers.sections import landmark_row
from impslam.types import Array, Ints, Landmark

MAX_ROWS = 20_000
"""Maximum number of poses of the path, evenly spaced; with the limits below, the page stays below 5 MB."""
MAX_POINTS = 400_000
"""Maximum number of beam end points; of more, every k-th beam is kept."""
MAX_CELLS = 4_000_000
"""Maximum number of grid cells; larger grids are coarsened."""
COVARIANCE = (("x", "x", 0, 0), ("x", "y", 0, 1), ("y", "y", 1, 1), ("h", "h", 2, 2))
"""Entries of a pose's covariance that are drawn or shown as numbers."""
SCRIPTS = ("data.js", "drawing.js", "pointer.js", "controls.js")
NOTE = (
    "Drag, scroll or pinch to move and zoom; hover to read values; click the path, the health band or a "
    "chart to go to that time. Keys, after a click on the map: space plays, ← → step, + − 0 zoom, r "
    "follows the robot, c colours the path, 1 to 9 toggle layers. Ellipses contain a point with 98.9 % "
    "probability (3σ)."
)
FIGURE = """<figure class="viewer" tabindex="0" aria-label="Map of the run">
<div class="stage"><canvas role="img" aria-label="Map with path, landmarks, scan and robot"></canvas>
<output class="readout"></output><div class="tip" hidden></div>
<div class="buttons"><button type="button" data-key="+" aria-label="Zoom in">+</button>
<button type="button" data-key="-" aria-label="Zoom out">−</button>
<button type="button" data-key="0" aria-label="Show all" title="Show all (0)">⤢</button>
<button type="button" data-key="r" aria-label="Follow the robot" title="Follow (r)">◎</button>
</div></div>
<div class="time"><button type="button" data-key=" " aria-label="Play">▶</button>
<input type="range" min="0" value="0" aria-label="Time"><output class="clock"></output>
<select class="speed" aria-label="Speed"></select></div>
<div class="choices"><div class="layers"></div>
<label>Path by <select class="colour"></select></label><span class="legend"></span></div>
<noscript>This map needs JavaScript; report.png shows it without.</noscript></figure>"""


def script() -> str:
    """Return the scripts as one, with a scope of its own."""
    parts = "".join(packaged(f"web/{name}") for name in SCRIPTS)
    return f'"use strict";\n(() => {{\n{parts}}})();\n'


def map_section(
    history: History, outcome: Outcome, image: MapImage, aligned: AlignedTruth | None
) -> str:
    """Return the section with the map and its data."""
    text = json.dumps(scene(history, outcome, image, aligned), ensure_ascii=False, allow_nan=False)
    safe = text.replace("<", "\\u003c")  # so that a log's name cannot end the element
    data = '<script type="application/json" id="scene">', safe, "</script>"
    return section("Map", FIGURE, *data, note=NOTE)


def scene(
    history: History, outcome: Outcome, image: MapImage, aligned: AlignedTruth | None
) -> dict[str, Any]:
    """Return the data that the scripts draw; lengths in m, angles in rad, times in s from `start`."""
    known, start = history.known, float(history.path[0, 0]) if len(history.path) else 0.0
    return {
        "start": start,
        "path": _path(history, outcome, aligned, start),
        "scans": _scans(known),
        "loops": _loops(known, start),
        "landmarks": [_landmark(mark, start) for mark in known.landmarks],
        "spans": [
            [span.begin - start, span.end - start, span.state, span.description]
            for span in outcome.health.spans()
        ],
        "grid": _grid(image),
    }


def packed(values: Any, kind: str) -> str:
    """Return values as "kind:base64"; kind is f4, i4, i2 or u1."""
    data = np.ascontiguousarray(values, np.dtype(f"<{kind}"))
    return f"{kind}:{base64.b64encode(data.tobytes()).decode()}"


def _path(
    history: History, outcome: Outcome, aligned: AlignedTruth | None, start: float
) -> dict[str, str]:
    """Return the columns of the path, a row for each scan shown."""
    known = history.known
    rows = _thinned(len(history.path), MAX_ROWS)
    path, spread = history.path[rows], history.covariances[rows]
    anchors = known.anchors[known.placed()][rows]
    columns = {
        **{name: path[:, i] - start * (i == 0) for i, name in enumerate("txyh")},
        **{a + b: spread[:, i, j] for a, b, i, j in COVARIANCE},
    }
    if not outcome.lidar_alone:
        columns |= {"ox": history.odometry[rows, 1], "oy": history.odometry[rows, 2]}
    if aligned is not None:
        true = _true_positions(history, aligned)[rows]
        columns |= {"tx": true[:, 0], "ty": true[:, 1]}
    packed_columns = {name: packed(column, "f4") for name, column in columns.items()}
    return packed_columns | {
        "scan": packed(anchors, "i4"),
        "drive": packed(known.keyframes.sessions[anchors], "i4"),
        "state": packed(health_of(known, outcome.health).states[rows], "u1"),
    }


def _thinned(count: int, max_rows: int) -> Ints:
    """Return at most `max_rows` evenly spaced rows of `count`, including the last."""
    step = -(-count // max_rows)
    return np.arange(count - 1, -1, -max(step, 1))[::-1]


def _true_positions(history: History, aligned: AlignedTruth) -> Array:
    """Return the true position (n, 2) in map at each scan, NaN if unknown."""
    true = np.full((len(history.path), 2), np.nan)
    rows = np.isin(history.path[:, 0], aligned.pairs.stamps)
    if np.count_nonzero(rows) == len(aligned.pairs.stamps):
        true[rows] = aligned.pairs.truth[:, :2]
    return true


def _scans(known: Map) -> dict[str, Any]:
    """Return the keyframes' poses and scans; points are i2, in `unit` m, in base_link."""
    keyframes = known.keyframes
    step = max(1, -(-len(keyframes.points) // MAX_POINTS))
    points, starts = keyframes.points[::step], -(-keyframes.starts // step)
    unit = max(float(np.abs(points).max(initial=0.0)) / 32767.0, 0.001)
    poses = {name: packed(keyframes.poses[:, i], "f4") for i, name in enumerate("xyh")}
    points = np.round(points / unit)
    return {**poses, "unit": unit, "starts": packed(starts, "i4"), "points": packed(points, "i2")}


def _loops(known: Map, start: float) -> dict[str, str]:
    """Return the loops as pairs of keyframes, their times, and their normalised innovation squared.

    Loops are the edges with a robust kernel, because they may be wrong; motions have none.
    """
    edges, at = known.edges, known.keyframes
    found = np.flatnonzero(np.isfinite(edges.kernel))
    i, j = edges.i[found], edges.j[found]
    error = between(at.poses[i], at.poses[j]) - edges.T_i_j[found]
    error[:, 2] = wrap(error[:, 2])
    nis = np.einsum("ki,kij,kj->k", error, edges.information[found], error)
    times = {"ti": at.stamps[i] - start, "tj": at.stamps[j] - start}
    columns = {name: packed(column, "f4") for name, column in {**times, "nis": nis}.items()}
    return columns | {"i": packed(i, "i4"), "j": packed(j, "i4")}


def _landmark(mark: Landmark, start: float) -> dict[str, Any]:
    """Return a landmark's geometry and the cells of its row in the table."""
    x, y = map(float, mark.position)
    (xx, xy), (_, yy) = mark.covariance.tolist()
    place: dict[str, Any] = {"x": x, "y": y, "cells": landmark_row(mark, start)}
    if mark.end_points is not None:
        return place | {"ends": mark.end_points.tolist()}
    return place | {"spread": [xx, xy, yy], "radius": mark.parameters.get("radius", 0.0)}


def _grid(image: MapImage) -> dict[str, Any]:
    """Return the grid as a PNG in the greys of `map.pgm`, with its position."""
    image = coarsened(image, MAX_CELLS)
    left, _, _, top = image.extent
    rows, columns = image.pixels.shape
    shape = {"rows": rows, "columns": columns, "cell": image.resolution}
    data = base64.b64encode(png(image.pixels)).decode()
    return {"png": f"data:image/png;base64,{data}", "left": left, "top": top, **shape}
