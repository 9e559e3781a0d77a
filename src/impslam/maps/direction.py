"""The main direction of a building: that of most of its walls, up to right angles.

Straight stretches of each scan give directions, weighted by their length. They are folded to a quarter
turn; the main direction is the mode of their histogram, refined by the circular mean of four times the
angle (Mardia & Jupp 2000, 9.2) of those close to it. Walls of other directions have no effect.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

LENGTH = 0.5
"""m, of a stretch: with 2 cm of range noise its direction is accurate to 2 degrees."""
MAX_RESIDUAL = 0.03
"""m, rms distance of the points of a stretch from their line: range noise, 1 to 3 cm."""
QUARTER = math.pi / 2
BINS = 90
"""Of the histogram: 1 degree each."""
TOLERANCE = math.radians(5.0)
"""Maximum deviation of stretches along the main direction: two and a half times their noise."""
MIN_SHARE = 0.35
"""Of all walls, along the main direction. With 20 randomly oriented walls, 11 % would be within `TOLERANCE`
of a direction, and 35 % with a probability of 0.001 (binomial)."""
MAX_RIVAL = 0.5
"""Share of any other direction over that of the main one. With more, e.g. in a triangle, none is the main
one."""
PARTS = 10
"""Parts of the drive with independent estimates, whose spread gives the standard error."""


class Direction(NamedTuple):
    """The main direction of the walls of a map.

    Attributes
    ----------
    angle : rad in (-pi/4, pi/4], from an axis of map to the walls
    sigma : rad, standard error from parts of the drive; inf if there is only one part
    share : share of the walls' length within 5 degrees of it or its right angle
    rival : the greatest share of another direction
    histogram : (BINS,) share of the walls' length by direction, from 0 to 90 degrees
    """

    angle: float
    sigma: float
    share: float
    rival: float
    histogram: tuple[float, ...]

    @property
    def is_clear(self) -> bool:
        """Whether there is a main direction."""
        return self.share >= MIN_SHARE and self.rival <= MAX_RIVAL * self.share


def main_direction(
    poses: Array, starts: Ints, points: np.ndarray[Any, np.dtype[np.float32]]
) -> Direction:
    """Return the main direction of the walls in scans.

    `poses` (k, 3) are those of the keyframes in map; the points (p, 2) of keyframe i are those from
    `starts[i]` up to `starts[i + 1]`, in its base_link, in the order of the beams.
    """
    found = np.empty((len(points), 3))
    angles, lengths, keyframe = found[: _stretches(poses, starts, points, found)].T
    if not len(angles):
        return Direction(0.0, math.inf, 0.0, 0.0, (0.0,) * BINS)
    angles = angles % QUARTER
    bins = (angles / QUARTER * BINS).astype(np.int64) % BINS
    histogram = np.bincount(bins, lengths, BINS) / lengths.sum()
    smooth = sum(np.roll(histogram, k) for k in range(-2, 3))
    angle = (int(np.argmax(smooth)) + 0.5) * QUARTER / BINS
    for _ in range(3):  # the window follows the mean, which converges
        angle += _mean(angles - angle, lengths)
    close = np.abs(_folded(angles - angle)) <= TOLERANCE
    share = float(lengths[close].sum() / lengths.sum())
    rival = _rival(angles[~close], lengths[~close]) / float(lengths.sum())
    part = (keyframe * PARTS / len(poses)).astype(np.int64)
    means = [_mean(angles[part == p] - angle, lengths[part == p]) for p in np.unique(part[close])]
    sigma = float(np.std(means, ddof=1)) / math.sqrt(len(means)) if len(means) > 1 else math.inf
    return Direction(
        float(_folded(np.array(angle))), sigma, share, rival, tuple(histogram.tolist())
    )


def _folded(angles: Array) -> Array:
    """Return angles in (-pi/4, pi/4], equal up to quarter turns."""
    return np.asarray(QUARTER / 2 - (QUARTER / 2 - angles) % QUARTER)


def _mean(angles: Array, lengths: Array) -> float:
    """Return the circular mean, up to quarter turns, of the angles close to 0; 0 without any."""
    close = np.abs(_folded(angles)) <= TOLERANCE
    four = 4.0 * angles[close]
    return 0.25 * math.atan2(
        float(lengths[close] @ np.sin(four)), float(lengths[close] @ np.cos(four))
    )


def _rival(angles: Array, lengths: Array) -> float:
    """Return the greatest length within `TOLERANCE` of one direction."""
    counts = np.bincount((angles / QUARTER * BINS).astype(np.int64) % BINS, lengths, BINS)
    width = round(2.0 * TOLERANCE / QUARTER * BINS)
    return float(np.max(sum(np.roll(counts, k) for k in range(width))))


@kernel
def _stretches(
    poses: Array, starts: Ints, points: np.ndarray[Any, np.dtype[np.float32]], out: Array
) -> int:
    """Fill `out` (n, 3) with direction in map, rad, length, m, and keyframe; return the number."""
    count = 0
    for k in range(len(poses)):
        if not math.isfinite(poses[k, 0] + poses[k, 1] + poses[k, 2]):
            continue
        for i in range(starts[k], starts[k + 1]):
            n, sx, sy, xx, xy, yy, span = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(i, starts[k + 1]):
                dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                n, sx, sy = n + 1.0, sx + dx, sy + dy
                xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
                span = math.sqrt(dx * dx + dy * dy)
                if span >= LENGTH:
                    break
            if n < 4.0 or span < LENGTH or span > 2.0 * LENGTH:
                continue
            xx, xy, yy = xx / n - (sx / n) ** 2, xy / n - sx * sy / n**2, yy / n - (sy / n) ** 2
            across = 0.5 * (xx + yy) - math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            if across > MAX_RESIDUAL * MAX_RESIDUAL:
                continue
            out[count, 0] = 0.5 * math.atan2(2.0 * xy, xx - yy) + poses[k, 2]
            out[count, 1], out[count, 2] = span / (n - 1.0), k
            count += 1
    return count
