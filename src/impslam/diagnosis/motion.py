"""Check whether the scans contain enough motion to compare them with odometry."""

from __future__ import annotations

from collections.abc import Iterator

from impslam.diagnosis.agreement import MIN_STRETCHES
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding

MIN_MOTION = 5.0
"""m + rad: total motion by odometry below which the log is too short for a comparison."""


def check_motion(e: Evidence) -> Iterator[Finding]:
    """Report that nothing could be compared, although the robot moved and the lidar scanned."""
    if e.agreement is None and e.odometry_total > MIN_MOTION and e.recording.scans:
        yield Finding(
            "not compared",
            f"the scans alone determine the motion over {len(e.lidar_motion)} stretches, of which "
            f"{MIN_STRETCHES} are needed, so mount, signs and scales were not checked",
            certainty=1.0,
            advice="inspect a log of a slow drive through a room",
            harmful=False,
            lidar=e.name,
        )
