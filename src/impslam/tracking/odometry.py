"""Dead reckoning: the motion is what odometry says (thesis 3.5)."""

from __future__ import annotations

from impslam.component import register
from impslam.tracking.base import Tracker


@register("odometry")
class OdometryTracker(Tracker):
    """Follows odometry alone, as the thesis does."""
