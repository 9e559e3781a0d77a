"""The report's section on the agreement of the scans with each other."""

from __future__ import annotations

import math

from impslam.evaluation.quality import Quality
from impslam.observers.page import section, table

NOTE = (
    "Scans of the same place are compared with each other, without ground truth. Lower is better; runs "
    "of the same log are ranked by the disagreement. A bend of the map is not detected if no place "
    "was seen twice."
)


def quality_section(found: Quality) -> str:
    """Return the table of the map's quality; "" if no surface is seen by two scans."""
    if math.isnan(found.disagreement):
        return ""
    rows = [
        ("disagreement", "mean of the two rows below", _cm(found.disagreement)),
        ("within a pass", "mean error of points seen in the same pass", _cm(found.within)),
        ("between passes", "mean error of points seen in different passes", _cm(found.between)),
        ("thickness of surfaces", "RMS distance of points from a surface", _cm(found.thickness)),
        (
            "free space contradicted",
            "share of points that other scans saw through",
            _percent(found.contradicted),
        ),
        (
            "doubled walls",
            "share of points with a parallel wall beside them",
            _percent(found.doubled),
        ),
        ("revisited", "share of places seen in different passes", _percent(found.revisited)),
    ]
    return section("Map quality", table(("", "", "value"), rows, text=2), note=NOTE)


def _cm(metres: float) -> str:
    return f"{100.0 * metres:.2f} cm" if math.isfinite(metres) else "-"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"
