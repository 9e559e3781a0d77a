"""Scans to check beams with: evenly spread over a log, of one layout, with ranges as received."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath, unmounted
from impslam.columns import Columns
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Mask

MAX_SCANS, MIN_SCANS = 400, 10
"""Scans that are checked, and the least number of them."""


class BeamSamples(NamedTuple):
    """Samples of scans.

    `ranges` (m, n) as received, `valid` (m, n) by the config, `angles` (n,) rad, `headings` (m,) rad along
    the path of the lidar; `limit` m, the largest valid range, inf without one.
    """

    ranges: Array
    valid: Mask
    angles: Array
    headings: Array
    limit: float = np.inf


def beam_samples(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath) -> BeamSamples | None:
    """Return scans evenly spread over those of the commonest layout; None if there are too few.

    The times of their beams may differ: some drivers measure each revolution.
    """
    layouts, starts = [_layout(piece) for piece in scans], np.cumsum([0, *map(len, scans)])
    counts = Counter[tuple[bytes, ...]]()
    for layout, piece in zip(layouts, scans, strict=True):
        counts[layout] += len(piece)
    if max(counts.values(), default=0) < MIN_SCANS:
        return None
    ((commonest, count),) = counts.most_common(1)
    alike = [k for k, layout in enumerate(layouts) if layout == commonest]
    some = np.unique(np.linspace(0, count - 1, min(MAX_SCANS, count)).astype(np.int64))
    rows = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in alike])[some]
    first = scans[alike[0]]
    columns = {name: np.concatenate([scans[k][name] for k in alike])[some] for name in first.values}
    piece = Columns(first.stream, first.kind, rows, columns, first.layout)
    seen = unmounted(lidar).sweeps(piece, np.zeros((len(rows), 3)))
    return BeamSamples(
        piece["ranges"], seen.valid, piece["angles"], path.poses[rows, 2], seen.range_max
    )


def _layout(scans: Columns) -> tuple[bytes, ...]:
    """Return what scans with the same columns, beams and limits share."""
    names = "angles", "range_min", "range_max"
    shared = (np.asarray(scans[name], np.float64).tobytes() for name in names)
    return (" ".join(scans.values).encode(), *shared)
