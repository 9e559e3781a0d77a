"""Noiseless scans of a floor of two rooms, from lidars mounted anyhow."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from impslam.geometry import se2
from impslam.graph.bearings import ScanFeatures
from impslam.surfaces.features import Sampling, beam_spacing, find_features


def _walls(corners):
    closed = [*corners, corners[0]]
    return [[*a, *b] for a, b in pairwise(closed)]


WALLS = np.array(
    _walls([(0, 0), (7, 0), (7, 2.2), (9, 2.2), (9, -1), (14, -1), (14, 5), (9, 5), (9, 3.4),
            (7, 3.4), (7, 6), (3, 6), (3, 5), (0, 5)])
    + _walls([(2, 2), (2.9, 2.3), (2.6, 3.2), (1.7, 2.9)])
    + _walls([(11, 1.2), (12, 1.2), (12, 2.6), (11, 2.6)])
)  # fmt: skip
"""(s, 4) m; two rooms, a door between them, a box in each."""


class Mount(NamedTuple):
    """A lidar on a robot: pose in base_link, angles of its beams, and which side is up."""

    pose: tuple[float, float, float]
    first: float
    last: float
    beams: int
    up: float = 1.0


FRONT = Mount((0.2, 0.05, 0.0), -math.pi / 2, math.pi / 2, 361)
UPSIDE_DOWN = Mount((0.2, 0.05, 0.1), -math.pi / 2, math.pi / 2, 361, -1.0)
BACKWARDS = Mount((-0.25, 0.1, math.pi), -math.pi / 2, math.pi / 2, 361)
ALL_ROUND = Mount((0.1, -0.15, 2.0), 0.0, 2 * math.pi * 719 / 720, 720)
CLOCKWISE = Mount((0.1, -0.15, 2.0), 1.0, 1.0 - 2 * math.pi * 719 / 720, 720)
MOUNTS = {
    "front": FRONT,
    "upside_down": UPSIDE_DOWN,
    "backwards": BACKWARDS,
    "all_round": ALL_ROUND,
    "clockwise": CLOCKWISE,
}


def ranges_at(pose, mount):
    """Return the ranges (n,) of a scan from a pose of the robot."""
    laser = se2.compose(np.array(pose, float), np.array(mount.pose))
    angles = laser[2] + mount.up * np.linspace(mount.first, mount.last, mount.beams)
    d = np.stack([np.cos(angles), np.sin(angles)], 1)[:, None]
    start, along = WALLS[:, :2] - laser[:2], WALLS[:, 2:] - WALLS[:, :2]
    den = d[..., 0] * along[:, 1] - d[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / den
        u = (start[:, 0] * d[..., 1] - start[:, 1] * d[..., 0]) / den
        return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(1)


def features_at(pose, mount=FRONT, noise=None, thin=0.04):
    """Return the features (n, 5) in base_link of a scan; `noise` (n,) m is added to its ranges."""
    ranges = ranges_at(pose, mount) + (0.0 if noise is None else noise)
    angles = np.linspace(mount.first, mount.last, mount.beams)
    bearings = mount.pose[2] + mount.up * angles
    origin = np.array(mount.pose[:2])
    points = origin + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], 1)
    out = np.empty((len(ranges), 5), np.float32)
    origins = np.tile(origin, (len(ranges), 1))
    spacing, valid = beam_spacing(angles), np.isfinite(ranges)
    return out[
        : find_features(points, valid, ranges, origins, Sampling(spacing, thin, smooth=True), out)
    ]


def scans_at(poses, mount=FRONT, noise=None):
    """Return `ScanFeatures` from poses (k, 3); `noise` (k, n) m."""
    noise = [None] * len(poses) if noise is None else noise
    rows = [features_at(pose, mount, e) for pose, e in zip(poses, noise, strict=True)]
    starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    return ScanFeatures(np.concatenate(rows), starts, np.array(mount.pose[:2]))


def drive():
    """Return poses (k, 3) of two rounds through both rooms."""
    corners = [(1, 1), (6, 1), (6.2, 2.8), (10, 2.8), (10, 0), (13, 0), (13, 4), (10, 4),
               (9.8, 2.8), (6, 2.9), (5.5, 4.8), (3.5, 4.2), (1, 4.2), (1, 1)]  # fmt: skip
    rows = []
    for a, b in pairwise(corners):
        way = np.subtract(b, a)
        heading, n = math.atan2(way[1], way[0]), max(1, round(math.hypot(*way) / 0.5))
        rows += [[*(np.array(a) + way * s / n), heading] for s in range(n)]
    one = np.array(rows)
    return np.concatenate([one, one + np.array([0.12, 0.15, 0.05])])
