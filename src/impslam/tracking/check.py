"""Whether odometry tells of the motion that the scans show, and what stands in for it where it does not.

A wheel that slips, an encoder that freezes or falls silent: odometry then says little or nothing, and
says it with no covariance, for its noise grows with the way that it tells of. That an encoder stands is no
proof that the robot does. Here each scan is matched to the last metres with a prior so wide that odometry
cannot bind it. Over a few seconds the two motions must agree: their difference d has the covariance S of
odometry and of matching, and d^T S^-1 d is chi-square distributed with three degrees of freedom
(Bar-Shalom et al. 2001, ch. 5.4). Beyond the gate the scans' motion takes the place of odometry's, from the
beginning of those seconds on, with a noise that grows with time where scans tell nothing. A robot that
stands is not contradicted, so that its covariance does not grow.
"""

from __future__ import annotations

import math
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions, Sweeps
from impslam.errors import NumericalError
from impslam.geometry.se2 import between, compose, rotation
from impslam.tracking.icp import Icp, gap
from impslam.tracking.local_map import REACH
from impslam.types import Array, Increment, Mask, Scan

SECONDS = 3.0
"""s over which both motions are compared: a robot that creeps at 5 cm/s goes 15 cm, which is seen."""
MOST = 300
"""Scans that are compared at most, where a clock stands: those of a lidar of 100 Hz."""
GATE = 21.1
"""d^T S^-1 d that one comparison in 10 000 exceeds by chance (chi-square, three degrees of freedom)."""
RATES = np.array([1.0, 0.5, 1.0])
"""m, m, rad, all /sqrt(s): how far a robot may have gone along, across and about while odometry cannot be
believed: as far as one at walking pace whose speed changes each second."""
SPREAD = np.array([0.03, 0.03, 0.02])
"""m, m, rad: what matching may be off by between any two places: surfaces are rough, people walk, and
half a lidar's view of a few metres is turned by 3 cm."""
SHARE = 0.1
"""Of the way (m) and the turn (rad), what matching may be off by: new points are laid beside old ones by
the pose that they are to tell, and a corridor's walls are the same everywhere."""
LACKS = 0.7
"""Share of the motion shown below which odometry lacks some of it: a frozen wheel tells half of the way.
Odometry that tells more than happened, or another direction, is left to its own covariance: scans of
bushes, of people or of a long corridor can show anything, but seldom a way that was not gone."""
LEAST = (0.05, 0.1)
"""m, rad: what has to lack at least; matching is off by less (`SPREAD`, to three sigma)."""
FEWEST = 2 * REACH + 1
"""Points without a gap between them that tell which way a surface runs."""


START = np.zeros(3)


class Checked(NamedTuple):
    """The motions to use, and at which sweeps (m,) the scans contradict the odometry."""

    motions: Motions
    contradicted: Mask


class _Place(NamedTuple):
    """Where each chain of motions is at a time (s): as matched, by odometry, and as handed on."""

    time: float
    matched: Array
    odometry: Array
    used: Array
    spread: Array
    """(3, 3) odometry's covariance added up, along the axes of its first place."""


class OdometryCheck:
    """Compares odometry with scans; the motion that it returns is odometry's while they agree.

    Where they do not, it is the scans' with `follow`; without, it is still odometry's, so unsure that
    a tracker which matches scans itself finds the motion from there.
    """

    def __init__(self, *, follow: bool = True) -> None:
        self._follow = follow
        self._icp = Icp(spacing=0.1, min_share=0.5)
        self._places: deque[_Place] = deque(maxlen=MOST)
        self._stamp = 0.0

    def check(self, motions: Motions, sweeps: Sweeps) -> Checked:
        """Return the motions to these sweeps as they are best taken; call it once for each sweep."""
        contradicted = np.zeros(len(sweeps), np.bool_)
        if sweeps.scans is None:
            return Checked(motions, contradicted)
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        for k in range(len(sweeps)):
            increment = motions.row(k)
            with suppress(NumericalError):  # where scans tell nothing, odometry stands
                chosen = self.agreed(increment, sweeps.scans.row(k))
                contradicted[k] = chosen is not increment
                d_pose[k], covariance[k] = chosen.d_pose, chosen.covariance
        return Checked(motions._replace(d_pose=d_pose, covariance=covariance), contradicted)

    def agreed(self, increment: Increment, scan: Scan) -> Increment:
        """Return the motion since the previous scan as it is best taken: itself, if both agree."""
        last = self._places[-1] if self._places else None
        # A clock may be set, back or ahead.
        elapsed = 0.0 if last is None else min(max(increment.stamp - self._stamp, 0.0), SECONDS)
        self._stamp = increment.stamp
        wide = increment.covariance + np.diag(np.square(RATES) * elapsed)
        matched = self._icp.match(replace(increment, covariance=wide), _supported(scan))
        if last is None:
            self._places.append(_Place(0.0, START, START, START, np.zeros((3, 3))))
            return increment
        place = _Place(
            last.time + elapsed,
            compose(last.matched, matched.d_pose),
            compose(last.odometry, increment.d_pose),
            last.used,
            last.spread + _turned(increment.covariance, last.odometry[2]),
        )
        while len(self._places) > 1 and self._places[1].time < place.time - SECONDS:
            self._places.popleft()
        first = self._places[0]
        contradicted = _lost_motion(first, place) and _distance2(first, place) > GATE
        chosen = increment
        if contradicted:
            unsure = replace(increment, covariance=wide)
            chosen = self._instead(first, place, matched) if self._follow else unsure
        self._places.append(place._replace(used=compose(last.used, chosen.d_pose)))
        return chosen

    def _instead(self, first: _Place, place: _Place, matched: Increment) -> Increment:
        """Return the motion that takes what was used so far to where matching is.

        What that makes good on top of the newest motion has perhaps been made good by landmarks before,
        so all of it is unsure.
        """
        motion = between(first.matched, place.matched)
        d_pose = between(between(first.used, place.used), motion)
        late = between(matched.d_pose, d_pose)
        way, turn = math.hypot(matched.d_pose[0], matched.d_pose[1]), abs(float(matched.d_pose[2]))
        off = SHARE**2 * self._icp.memory * np.array([way, way, turn])
        covariance = matched.covariance + np.diag(off) + np.outer(late, late)
        return replace(matched, d_pose=d_pose, covariance=covariance)


def _lost_motion(first: _Place, place: _Place) -> bool:
    """Tell whether odometry lacks a good part of the way, or of the turn, that the scans show."""
    told = between(first.odometry, place.odometry)
    shown = between(first.matched, place.matched)
    way, seen = math.hypot(told[0], told[1]), math.hypot(shown[0], shown[1])
    return bool(way < LACKS * seen - LEAST[0] or abs(told[2]) < LACKS * abs(shown[2]) - LEAST[1])


def _distance2(first: _Place, place: _Place) -> float:
    """Return d^T S^-1 d of the two motions from the first place on."""
    told = between(first.odometry, place.odometry)
    d = between(told, between(first.matched, place.matched))
    S = _turned(place.spread - first.spread, -place.odometry[2])
    lever = np.array([told[1], told[0], 0.0])  # of a heading that was wrong all the way, at most
    shown = between(first.matched, place.matched)
    way = np.maximum(np.abs(told), np.abs(shown))
    off = np.square(SPREAD) + np.square(SHARE * np.array([way[:2].max(), way[:2].max(), way[2]]))
    S += np.diag(off + np.square(lever) * S[2, 2])
    return float(d @ np.linalg.solve(S, d))


def _turned(covariance: Array, angle: float) -> Array:
    """Return a covariance (3, 3) of [x, y, theta] along axes turned back by an angle in rad."""
    V = np.eye(3)
    V[:2, :2] = rotation(angle)
    return np.asarray(V @ covariance @ V.T)


def _supported(scan: Scan) -> Scan:
    """Return the scan without points that are too few together to tell a surface.

    The far end of a wall that beams graze is such points; it comes along with the robot.
    """
    points = np.where(scan.valid[:, None], scan.points, np.inf)
    with np.errstate(invalid="ignore"):
        apart = ~(np.hypot(*np.diff(points, axis=0).T) < gap(scan))
    groups = np.concatenate([[0], np.cumsum(apart)])
    return replace(scan, valid=scan.valid & (np.bincount(groups)[groups] >= FEWEST))
