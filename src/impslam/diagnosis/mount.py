"""Where the laser is mounted: turned, and ahead of the axle or behind it."""

from __future__ import annotations

import math

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding, certainty, is_off
from impslam.diagnosis.handedness import handedness
from impslam.diagnosis.robust import fit
from impslam.diagnosis.scales import RANGES, scales
from impslam.geometry.angles import wrap
from impslam.health import MISALIGNED, Standing

ASKEW = math.radians(2.0)
"""What a laser mounted by eye is askew by: 3.5 cm per metre, as much as odometry strays sideways."""
FITS = 0.7
"""Share of stretches that obey the axis, below which the robot does not drive along one."""


def mount(e: Evidence) -> list[Finding]:
    """Find a laser that is turned, or that stands elsewhere, than the config says."""
    if e.axis is None or e.agreement is None or e.axis.inliers < FITS:
        return []
    if handedness(e):
        return []
    yaw = wrap(-e.axis.angle)
    off = wrap(yaw - e.lidar.mount[2])
    sigma = math.sqrt(e.axis.covariance[0, 0])
    if is_off(off, sigma, ASKEW):
        return [_turned(e, yaw, off, sigma)]
    return _elsewhere(e)


def _turned(e: Evidence, yaw: float, off: float, sigma: float) -> Finding:
    x, y, _ = e.lidar.mount
    if not e.is_mount_given:
        x = e.axis.ahead if e.axis is not None else x
    what = (
        f"the laser is turned by {math.degrees(yaw):.1f} ± {math.degrees(sigma):.1f} deg from the "
        f"direction in which the robot drives; its mount says {math.degrees(e.lidar.mount[2]):.1f} deg"
    )
    astern = abs(off) > math.radians(135.0)
    return Finding(
        "laser turned",
        what,
        (f"{e.place}.mount=[{x:.3f},{y:.3f},{yaw:.4f}]",),
        certainty(off, sigma, ASKEW),
        "if the mount is right, odometry logs ways forward as backward" if astern else "",
        health=Standing(MISALIGNED, abs(math.degrees(off))),
    )


def _elsewhere(e: Evidence) -> list[Finding]:
    """Compare how far ahead of the axle the laser stands with its mount.

    Of odometry that tells sideways motion base_link need not be on the axle: it goes sideways by so much
    per turn as it lies ahead of it.
    """
    assert e.axis is not None
    if any(finding.kind == RANGES for finding in scales(e)):
        return []  # first the metres, then the places
    base = fit(e.gone[:, 2:], e.gone[:, 1])
    x, y, yaw = e.lidar.mount
    ahead = e.axis.ahead - float(base.p[0])
    sigma = math.hypot(math.sqrt(e.axis.covariance[1, 1]), float(base.sigma[0]))
    allowed = 3.0 * (e.lidar.sigma + e.lidar.bias)  # what a range is off by itself, at worst
    if not is_off(ahead - x, sigma, allowed):
        return []
    given = f"its mount says {x:.3f} m" if e.is_mount_given else "its mount is not known"
    return [
        Finding(
            "laser elsewhere",
            f"the laser stands {ahead:.3f} ± {np.fmax(sigma, 1e-3):.3f} m ahead of the axle; {given}",
            (f"{e.place}.mount=[{ahead:.3f},{y:.3f},{yaw:.3f}]",),
            certainty(ahead - x, sigma, allowed),
            harmful=e.is_mount_given,
        )
    ]
