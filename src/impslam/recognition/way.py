"""Where in a map a robot is, from several scans of a short way.

The scans are one query: what they saw, joined by the motions between them. It is searched for anew with
each scan, and the hypotheses of before are followed too, so that none is lost which a search for other
points may leave out. All of them have to explain all scans of the way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import plain
from impslam.geometry.se2 import compose, compose_uncertain, inverse
from impslam.recognition.relocalisation import Answer, Near, Relocaliser, query
from impslam.recognition.submap import View
from impslam.types import Array

SPACING, TURN = 0.4, 0.35  # m, rad: scans closer together see the same
MOST = 8  # scans, of 3 m of way
BENT, BENT_TURN = 0.3, 0.05
"""m and rad, one sigma: a way that its motions tell less well does not lie on the map as one piece, for
alignment pairs points up to 0.3 m apart; the turn moves what is 6 m away by as much."""
KEPT = 1e-4  # odds of a hypothesis that is followed, at least


class _Seen(NamedTuple):
    """A view and the motion (3,) to it from the one before, with its covariance (3, 3)."""

    view: View
    motion: Array
    covariance: Array


class WayRelocaliser:
    """Finds a robot that drives, in a map; it remembers the last few metres of its way."""

    def __init__(self, relocaliser: Relocaliser) -> None:
        self._relocaliser = relocaliser
        self._way: list[_Seen] = []
        self._hypotheses: list[Array] = []

    def add(self, view: View, motion: Array, covariance: Array, near: Near | None = None) -> Answer:
        """Remember a scan, and return where the robot is now; see `remember` and `find`."""
        self.remember(view, motion, covariance)
        return self.find(near)

    def remember(self, view: View, motion: Array, covariance: Array) -> None:
        """Go on with a scan, which is much faster than a search.

        Parameters
        ----------
        view : what the robot sees now
        motion, covariance : (3,) of base_link since the scan before, and (3, 3) of an additive error on
            it; of no meaning for the first one
        """
        self._hypotheses = [compose(pose, motion) for pose in self._hypotheses]
        self._append(_Seen(view, plain(motion), plain(covariance)))
        self._forget()

    def find(self, near: Near | None = None) -> Answer:
        """Return where the robot is now; `near` is a hint."""
        sought = query([seen.view for seen in self._way], self._poses())
        answer = self._relocaliser.find_query(sought, near, self._hypotheses)
        self._hypotheses = [h.pose for h in answer.hypotheses if h.odds >= KEPT]
        return answer

    def _append(self, seen: _Seen) -> None:
        """Append a view; the last one is left out if the robot has hardly moved since the one before."""
        if len(self._way) > 1:
            last = self._way[-1]
            if math.hypot(*last.motion[:2]) < SPACING and abs(last.motion[2]) < TURN:
                self._way.pop()
                motion, covariance = compose_uncertain(
                    last.motion, last.covariance, seen.motion, seen.covariance
                )
                seen = _Seen(seen.view, motion, covariance)
        self._way.append(seen)

    def _forget(self) -> None:
        """Drop the views from which the way to the newest one is not known well enough."""
        T, P = np.zeros(3), np.zeros((3, 3))
        for k in range(len(self._way) - 1, 0, -1):
            T, P = compose_uncertain(self._way[k].motion, self._way[k].covariance, T, P)
            bent = math.sqrt(P[0, 0] + P[1, 1]) > BENT or math.sqrt(P[2, 2]) > BENT_TURN
            if bent or len(self._way) - k >= MOST:
                del self._way[:k]
                return

    def _poses(self) -> Array:
        """Return the poses (k, 3) of the views, seen from the newest one."""
        poses = np.zeros((len(self._way), 3))
        for k in range(len(poses) - 1, 0, -1):
            poses[k - 1] = compose(poses[k], inverse(self._way[k].motion))
        return poses
