"""Find ranges that are in mm: nearly all of them are longer than any 2D lidar measures."""

from __future__ import annotations

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding

MIN_MEDIAN = 100.0
"""m, twice the range of a usual 2D lidar outdoors; in mm, closer than most surfaces that a robot sees."""
MIN_SHARE = 0.9
"""Share of the ranges beyond the limit: in mm, all but those of its own body; in m, those in the open."""
MILLIMETRES = 1000.0


def check_unit(e: Evidence) -> list[Finding]:
    """Find ranges in mm."""
    sample = e.samples
    if sample is None:
        return []
    ranges = sample.ranges[np.isfinite(sample.ranges) & (sample.ranges > 0.0)]
    share = float((ranges > sample.limit).mean()) if len(ranges) else 0.0
    if share < MIN_SHARE or (median := float(np.median(ranges))) < MIN_MEDIAN:
        return []
    what = (
        f"{100.0 * share:.1f} % of the ranges are beyond range_max, {sample.limit:.4g} m, with a median of "
        f"{median:.0f} m: they are in mm"
    )
    if sample.limit != e.lidar.range_max:  # no setting raises the limit in the messages
        advice = "write ranges in m like range_max, as ROS demands, or both in mm"
        return [Finding("ranges in mm", what, advice=advice, lidar=e.name)]
    scale = f"{e.lidar_key}.range_scale={1.0 / MILLIMETRES:g}"
    limit = f"{e.lidar_key}.range_max={MILLIMETRES * sample.limit:g}"
    return [Finding("ranges in mm", what, (scale, limit), lidar=e.name)]
