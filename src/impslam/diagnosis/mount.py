"""Check the laser's mount: its yaw, and its position ahead of the axle or behind it."""

from __future__ import annotations

import math

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding, is_off, probability_off
from impslam.diagnosis.handedness import check_handedness
from impslam.diagnosis.robust import fit
from impslam.diagnosis.scales import RANGES, check_scales
from impslam.geometry.angles import wrap
from impslam.health import MISALIGNED, LogFault

YAW_TOLERANCE = math.radians(2.0)
"""Typical error of a laser mounted by eye: 3.5 cm per metre, as much as odometry drifts sideways."""
MAX_Y_SIGMA = 0.02
"""m: a tape measure is as good."""
MIN_INLIERS = 0.7
"""Share of stretches that fit the axis; below it, the robot does not drive along an axis."""


def check_mount(e: Evidence) -> list[Finding]:
    """Find a laser whose yaw or position differs from its mount in the config."""
    if e.axis is None or e.agreement is None or e.axis.inliers < MIN_INLIERS:
        return []
    if check_handedness(e):
        return []
    yaw = wrap(-e.axis.angle)
    off = wrap(yaw - e.lidar.mount[2])
    sigma = math.sqrt(e.axis.covariance[0, 0])
    if is_off(off, sigma, YAW_TOLERANCE):
        return [_rotated(e, yaw, off, sigma)]
    return _displaced(e)


def _rotated(e: Evidence, yaw: float, off: float, sigma: float) -> Finding:
    assert e.axis is not None
    x, y, _ = e.lidar.mount
    if not e.is_mount_given:
        x = e.axis.ahead
    ahead = "the driving direction" if e.axis.has_axle else "the direction ahead by odometry"
    what = (
        f"the lidar is rotated by {math.degrees(yaw):.2f} ± {math.degrees(sigma):.2f} deg from {ahead}; "
        f"its mount is given as {math.degrees(e.lidar.mount[2]):.2f} deg"
    )
    advice = _sideways(e)
    if abs(off) > math.radians(135.0):
        advice += "; if the mount is correct, odometry reports forward motion as backward"
    return Finding(
        "lidar rotated",
        what,
        (f"{e.lidar_key}.mount=[{x:.3f},{y:.3f},{yaw:.4f}]",),
        probability_off(off, sigma, YAW_TOLERANCE),
        advice,
        fault=LogFault(MISALIGNED, abs(math.degrees(off))),
        lidar=e.name,
    )


def _displaced(e: Evidence) -> list[Finding]:
    """Compare the laser's position ahead of the axle with its mount.

    If odometry reports some sideways motion, base_link need not be on the axle: its sideways motion per
    turn is its distance ahead of the axle.
    """
    assert e.axis is not None
    if any(finding.kind == RANGES for finding in check_scales(e)):
        return []  # positions are meaningful only once ranges are in metres
    x, y, yaw = e.lidar.mount
    ahead, variance = e.axis.ahead, float(e.axis.covariance[1, 1])
    if e.axis.has_axle:
        base = fit(e.odometry_motion[:, 2:], e.odometry_motion[:, 1])
        ahead, variance = ahead - float(base.p[0]), variance + float(base.covariance[0, 0])
    sigma = math.sqrt(variance)
    allowed = 3.0 * (e.lidar.sigma + e.lidar.bias)  # largest error of a range itself
    if not is_off(ahead - x, sigma, allowed):
        return []
    origin = "the axle" if e.axis.has_axle else "base_link"
    given = f"its mount is given as {x:.3f} m" if e.is_mount_given else "its mount is unknown"
    return [
        Finding(
            "lidar displaced",
            f"the lidar is {ahead_of(origin, ahead, sigma)}; {given}",
            (f"{e.lidar_key}.mount=[{ahead:.3f},{y:.3f},{yaw:.3f}]",),
            probability_off(ahead - x, sigma, allowed),
            _sideways(e),
            harmful=e.is_mount_given,
            lidar=e.name,
        )
    ]


def _sideways(e: Evidence) -> str:
    """Say what is known of the laser's y, which the setting leaves as it is.

    In a turn T, a laser to the left of base_link moves by y T less ahead than the distance by odometry, so
    y is b / a of the agreement of both; without turns, or without odometry, nothing shows it.
    """
    kept = f"y stays {e.lidar.mount[1]:.3f} m"
    if e.agreement is not None and e.odometry_moves:
        scale = float(e.agreement.distance.p[0])
        sigma = float(e.agreement.distance.sigma[1]) / max(abs(scale), 1e-9)
        if sigma < MAX_Y_SIGMA:
            y = float(e.agreement.distance.p[1]) / scale
            return f"{kept}; by odometry it is {y:.3f} ± {max(sigma, 1e-3):.3f} m"
    return f"{kept}: the drive does not show it, so measure it"


def ahead_of(origin: str, ahead: float, sigma: float) -> str:
    """Return a position ahead of the origin, or behind it if negative, with its standard deviation, m."""
    side = "behind" if ahead < 0.0 else "ahead of"
    return f"{abs(ahead):.3f} ± {max(sigma, 1e-3):.3f} m {side} {origin}"
