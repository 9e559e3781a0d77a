"""Tracker that matches scans with maps of the last metres, with odometry as a robust prior."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import parameter, register
from impslam.noise import MotionNoise
from impslam.surfaces.surface_map import Alignment, no_evidence
from impslam.tracking.base import Gate, Tracker
from impslam.tracking.beams import beam_columns
from impslam.tracking.intervals import no_intervals
from impslam.tracking.jump import no_past
from impslam.tracking.learned_odometry import initial_odometry
from impslam.tracking.match_faults import initial_faults
from impslam.tracking.matching_state import (
    FrozenOdometry,
    LidarState,
    Settings,
    State,
)
from impslam.tracking.per_lidar import PerLidar
from impslam.tracking.pose_search import USUAL_RMS, USUAL_SHARE
from impslam.tracking.scan_matching import follow
from impslam.tracking.stall import initial_stall_state
from impslam.tracking.steps import Steps
from impslam.tracking.submaps import empty_submaps


@register("scan_to_map")
class ScanToMap(Tracker):
    """Matches scans with maps of the last metres; odometry is a prior that may be wrong."""

    matches_scans: ClassVar[bool] = True

    sigma: float = parameter(
        0.035,
        "m",
        "standard deviation of one point's distance; more than the lidar's noise, because the points "
        "of a surface share errors",
        gt=0,
    )
    wide: float = parameter(
        0.4, "m", "initial scale of the robust kernel: the error of odometry", gt=0, le=2
    )
    narrow: float = parameter(
        0.06, "m", "final scale of the kernel: three times a lidar's noise", gt=0, le=2
    )
    iterations: int = parameter(14, "1", "maximum number of linearisations", ge=1, le=100)
    reach: float = parameter(
        50.0,
        "m",
        "range of the submaps around the robot; points beyond it are left out",
        gt=1,
        le=200,
    )
    length: float = parameter(
        12.0, "m", "distance that a submap lasts for: a few rooms, and drift of a few cm", gt=0
    )
    spacing: float = parameter(0.4, "m", "a scan is added to the submaps after this distance", gt=0)
    turn: float = parameter(0.4, "rad", "or after this turn", gt=0)
    thin: float = parameter(0.04, "m", "points nearer to each other are merged", ge=0)
    smooth: bool = parameter(
        True, "", "points are moved onto their surfaces, as far as they scatter by noise"
    )
    drift: MotionNoise = parameter(
        MotionNoise(forward=0.005, sideways=0.005, turn_per_distance=0.0025, turn_per_turn=0.005),
        "",
        "drift of matched motion: surfaces look different from different positions. In recorded "
        "buildings it is 0.3 to 0.8 of the default, most on ramps and in large rooms",
    )
    _state: State = PrivateAttr()
    _seen: PerLidar[LidarState] = PrivateAttr()
    _sensor: str = PrivateAttr("")
    """The lidar of the newest sweep; "" before the first."""

    def model_post_init(self, context: object) -> None:
        """Begin with empty submaps."""
        self._seen = PerLidar(_no_scans)
        self._state = State(
            empty_submaps(self.reach + self.length),
            initial_odometry(),
            pose=np.zeros(3),
            matched=np.zeros(3),
            motion=np.zeros(3),
            covariance=np.zeros((3, 3)),
            reported=np.zeros(1),
            error=np.zeros((3, 3)),
            travelled=np.zeros(3),
            stamp=np.full(1, np.nan),
            interval=np.full(2, np.nan),
            intervals=no_intervals(),
            velocity=np.zeros(3),
            prior=np.zeros(2),
            slip=np.zeros(2),
            reach=np.zeros(2),
            frozen=FrozenOdometry(np.zeros(1, np.bool_), np.zeros(1), np.zeros(1)),
            unlocated=np.zeros(1),
            averages=np.array([USUAL_SHARE, USUAL_RMS**2, 0.1]),
            evidence=no_evidence(),
            faults=initial_faults(),
            time=np.zeros(1),
            places=np.zeros(1, np.int64),
            proven=np.zeros(1),
            lidar=_no_scans(0),
        )

    def forget(self) -> None:
        """Free the memory of the submaps; a further scan would begin new ones."""
        self.model_post_init(None)

    def settings(self) -> Settings:
        """Return the parameters in the form that kernels take."""
        d = self.drift
        return Settings(
            Alignment(self.iterations, self.wide, self.narrow, self.sigma**-2, 1, np.inf),
            self.length,
            self.spacing,
            self.turn,
            self.thin,
            self.smooth,
            np.array([d.forward, d.sideways, d.turn_per_distance, d.turn_per_turn]),
        )

    def steps(self, motions: Motions, sweeps: Sweeps, gate: Gate) -> Steps:
        """Match each sweep with the submaps; see `Tracker.steps`."""
        beams = beam_columns(sweeps.scans, len(sweeps), sweeps.twists)
        lidar = self._seen.get(sweeps.sensor, beams.ranges.shape[1])
        self._state.faults.offsets.changed[0] |= self._sensor not in ("", sweeps.sensor)
        self._sensor = sweeps.sensor
        m = len(sweeps)
        reference, ends, located = np.zeros((3, m), np.bool_)
        out = Steps(
            np.empty((m, 3)), np.empty((m, 3, 3)), np.zeros((m, 3, 3)), np.empty((m, 3)), reference,
            ends, located,
            np.zeros(m, np.int8), np.zeros(m), np.zeros((m, 2)),
        )  # fmt: skip
        state = self._state._replace(lidar=lidar)
        follow(motions, beams, state, gate, self.settings(), out)
        return out


def _no_scans(beams: int) -> LidarState:
    """Return the state of a lidar with this number of beams before its first scan."""
    return LidarState(
        np.zeros(beams), np.zeros(3), np.full(3, np.nan), no_past(beams), initial_stall_state(beams)
    )
