"""The tracker that matches scans against the last metres of way, with odometry as prior."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import parameter, register
from impslam.geometry.kernels import kernel
from impslam.noise import MotionNoise
from impslam.tracking.base import Tracker
from impslam.tracking.local_map import LocalMap, empty_map
from impslam.tracking.matching import UNSOLVED, Settings, match
from impslam.tracking.surfels import Surfels, thin
from impslam.types import Ints

_UNSOLVED = "the scan at {:.3f} s: prior and scan admit no solution; odometry is used alone"


@kernel
def _match_all(motions: Motions, surfels: Surfels, known: LocalMap, settings: Settings) -> Ints:
    """Refine motions in place; return what came of each, see `match`."""
    status = np.empty(len(motions.stamps), np.int64)
    for k in range(len(status)):
        points = surfels.rows[surfels.starts[k] : surfels.starts[k + 1]]
        points = thin(points, settings.spacing, False)
        status[k] = match(motions.d_pose[k], motions.covariance[k], points, known, settings)
    return status


@register("icp")
class Icp(Tracker):
    """Iterated closest points against the last metres, with odometry as prior."""

    matches_scans: ClassVar[bool] = True

    sigma: float = parameter(
        0.02,
        "m",
        "standard deviation of one point's distance; more than the lidar's noise, because the points "
        "of one surface share its error",
        gt=0,
    )
    reach: float = parameter(
        0.5, "m", "a point and its partner are at most this far apart: the odometry's error", ge=0.1
    )
    spacing: float = parameter(0.05, "m", "points nearer to each other are one", gt=0)
    memory: float = parameter(6.0, "m", "points are forgotten after so much way", gt=0)
    iterations: int = parameter(15, "1", "linearisations at most", ge=1)
    min_share: float = parameter(
        0.4, "1", "share of the scan's points that must find a partner", gt=0, le=1
    )
    drift: MotionNoise = parameter(
        MotionNoise(forward=0.03, sideways=0.02, turn_per_distance=0.02, turn_per_turn=0.04),
        "",
        "what matched motion strays by all the same: surfaces are not the same from everywhere",
    )
    _known: LocalMap = PrivateAttr()
    _settings: Settings = PrivateAttr()

    def model_post_init(self, context: object) -> None:
        """Begin with an empty map."""
        self._known, self._settings = empty_map(), self.settings()

    def settings(self) -> Settings:
        """Return the parameters as kernels take them."""
        d = self.drift
        drift = np.array([d.forward, d.sideways, d.turn_per_distance, d.turn_per_turn])
        return Settings(
            self.sigma,
            self.reach,
            self.spacing,
            self.memory,
            self.iterations,
            self.min_share,
            drift,
        )

    @property
    def thinning(self) -> float:
        """Its own points', or those of the check, if these are nearer."""
        return min(self.spacing, super().thinning)

    def refine(self, motions: Motions, sweeps: Sweeps, surfels: Surfels | None) -> Motions:
        """Match each sweep against the local map; see `Tracker.refine`."""
        if surfels is None:
            return motions
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        refined = motions._replace(d_pose=d_pose, covariance=covariance)
        status = _match_all(refined, surfels, self._known, self._settings)
        for k in np.flatnonzero(status == UNSOLVED).tolist():
            self.problems.add("scan matching", _UNSOLVED.format(motions.stamps[k]))
        return refined
