"""The report's section on how well the scans agree with each other."""

from __future__ import annotations

import math

from impslam.evaluation.quality import Quality
from impslam.observers.page import section, table

NOTE = (
    "Needs no truth: scans of the same place are compared with each other. The less, the better; runs "
    "of the same log are ranked by the disagreement. A bend of the map where no place was seen "
    "twice is not detected."
)


def quality_section(found: Quality) -> str:
    """Return the table of the map's quality; nothing where no two scans see the same surface."""
    if math.isnan(found.disagreement):
        return ""
    rows = [
        ("disagreement", "mean of the next two", _cm(found.disagreement)),
        ("within a pass", "mean error of points seen in the same pass", _cm(found.within)),
        ("between passes", "mean error of points seen in different passes", _cm(found.between)),
        ("thickness of surfaces", "RMS distance of points from a surface", _cm(found.thickness)),
        (
            "free space contradicted",
            "of points, by scans that saw through them",
            _percent(found.contradicted),
        ),
        ("walls seen twice", "of points so, with a wall beside them", _percent(found.doubled)),
        ("revisited", "of the places, in different passes", _percent(found.revisited)),
    ]
    return section("Map quality", table(("", "", "value"), rows, text=2), note=NOTE)


def _cm(metres: float) -> str:
    return f"{100.0 * metres:.2f} cm" if math.isfinite(metres) else "-"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"
