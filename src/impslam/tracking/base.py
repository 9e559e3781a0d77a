"""The role of a tracker: it follows the robot from keyframe to keyframe.

A tracker knows nothing but what is relative to the newest keyframe, so a loop that closes is none
of its business.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import Component, parameter
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.kernels import kernel
from impslam.map import Keyframe, Track
from impslam.parameters import Parameters
from impslam.sources.base import Problems
from impslam.tracking.check import OdometryCheck
from impslam.tracking.surfels import Surfels, prepare
from impslam.types import Array, Increment, Mask

_CONTRADICTED = (
    "the scan at {:.3f} s shows another motion than odometry; the pose follows the scans: check "
    "encoders and wheels, or the parameters of odometry"
)


class KeyframeGate(Parameters):
    """Which scans are searched for landmarks: those after some motion, or after some time.

    Scans from one place repeat their errors (the surface's brightness, the mount, the lidar's own
    bias); taken for independent they make the belief surer than it may be. Between keyframes the
    pose is that of the tracker.
    """

    distance: float = parameter(
        0.12,
        "m",
        "a keyframe after this way: errors of surfaces repeat over a few decimetres; inf: never",
        special="inf",
        ge=0,
    )
    angle: float = parameter(
        0.06, "rad", "or after this turn: beams fall elsewhere; inf: never", special="inf", ge=0
    )
    seconds: float = parameter(
        0.5, "s", "or after this time, moving or not; inf: never", special="inf", ge=0
    )


class _Tracked(NamedTuple):
    """Sweeps with the motions to them, dead reckoning at their stamps, and what contradicts it."""

    motions: Motions
    sweeps: Sweeps
    odometry: Array
    contradicted: Mask


class Tracker(Component):
    """Turns motions and sweeps into tracks; `refine` is what differs between trackers."""

    role: ClassVar[str] = "tracker"
    matches_scans: ClassVar[bool] = False
    """Whether `refine` finds the motion from the scans, with odometry as a prior."""

    _gate: Array = PrivateAttr()
    _since: tuple[Array, Array] = PrivateAttr()
    _odometry: Array = PrivateAttr()
    _travelled: dict[str, Array] = PrivateAttr(default_factory=dict)
    _duration: float = PrivateAttr(0.0)
    _keyframes: int = PrivateAttr(0)
    _problems: Problems = PrivateAttr(default_factory=Problems)
    _check: OdometryCheck = PrivateAttr()

    def start(self, start: Array, gate: KeyframeGate) -> None:
        """Begin at a pose (3,) of the odometry's path; the first sweep is a keyframe."""
        self._gate = np.array([gate.distance, gate.angle, gate.seconds])
        self._travelled = {}
        self._since = np.zeros(3), np.zeros((3, 3))
        self._odometry = np.array(start, dtype=np.float64)
        self._duration, self._keyframes = 0.0, 0
        self._check = OdometryCheck(follow=not self.matches_scans)

    @property
    def problems(self) -> Problems:
        """What could not be tracked, and why."""
        return self._problems

    @property
    def since(self) -> tuple[Array, Array]:
        """The motion from the newest keyframe to the middle of the newest sweep: (3,) and (3, 3)."""
        return self._since

    @property
    def odometry(self) -> Array:
        """`T_odom_base` (3,) at the middle of the newest sweep, by dead reckoning."""
        return self._odometry

    @property
    def thinning(self) -> float:
        """The least distance of a sweep's points in beam order, m, that `refine` has a use for."""
        return OdometryCheck.spacing

    def refine(self, motions: Motions, sweeps: Sweeps, surfels: Surfels | None) -> Motions:
        """Return the motions to these sweeps as well as they can be told, with covariance.

        The motions given are those of odometry; `surfels` are the points of the sweeps, None where
        the sensor has none. Where a sweep tells nothing its motion comes back as it was.
        """
        del sweeps, surfels
        return motions

    def follow(self, motions: Motions, sweeps: Sweeps) -> Iterator[Track]:
        """Yield the tracks of these sweeps; a track is cut where the data are, and goes on.

        `motions` are by odometry, from the middle of the sweep before to that of each.
        """
        by_odometry = motions
        scans = sweeps.scans
        surfels = None if scans is None else prepare(scans, self.thinning)
        motions, contradicted = self._check.check(motions, surfels)
        for k in np.flatnonzero(contradicted).tolist():
            stamp = sweeps.columns.stamps[k]
            self._problems.add("odometry against scans", _CONTRADICTED.format(stamp))
        refined = self.refine(motions, sweeps, surfels)
        ends = self._ends(sweeps.sensor, motions)
        odometry, at_stamp = _dead_reckon(self._odometry, by_odometry.d_pose, sweeps.T_middle_stamp)
        self._odometry = odometry[-1] if len(odometry) else self._odometry
        tracked = _Tracked(refined, sweeps, at_stamp, contradicted)
        begin = 0
        for end in np.flatnonzero(ends).tolist():
            yield self._track(tracked, slice(begin, end), ends=True)
            begin = end + 1
        if begin < len(sweeps):
            yield self._track(tracked, slice(begin, len(sweeps)), ends=False)

    def _ends(self, sensor: str, motions: Motions) -> Mask:
        """Tell which sweeps are keyframes: each sensor looks at what the others do not see."""
        travelled = self._travelled.setdefault(sensor, np.full(3, math.inf))
        for name, others in self._travelled.items():
            if name != sensor:
                _keyframes(motions.d_pose, motions.duration, np.full(3, math.inf), others)
        return _keyframes(motions.d_pose, motions.duration, self._gate, travelled)

    def _track(self, tracked: _Tracked, rows: slice, *, ends: bool) -> Track:
        """Return the track of some rows, and with `ends` the keyframe in the row after them."""
        motions, sweeps, odometry, contradicted = tracked
        upto = rows.stop + 1 if ends else rows.stop
        T, spread, T_stamp, spread_stamp = _accumulate(
            *self._since,
            motions.d_pose[rows.start : upto],
            motions.covariance[rows.start : upto],
            sweeps.T_middle_stamp[rows.start : upto],
            sweeps.stamp_covariance[rows.start : upto],
        )
        self._duration += float(motions.duration[rows.start : upto].sum())
        m, keyframe = rows.stop - rows.start, None
        if ends:
            keyframe = self._keyframe(tracked, rows.stop, T[m], spread[m])
            self._since, self._duration = (np.zeros(3), np.zeros((3, 3))), 0.0
        elif m:
            self._since = T[m - 1], spread[m - 1]
        track = Track(
            self._keyframes - 1,
            sweeps.columns.stamps[rows],
            T_stamp[:m],
            spread_stamp[:m],
            odometry[rows],
            sweeps,
            rows,
            contradicted[rows],
            keyframe,
        )
        self._keyframes += ends
        return track

    def _keyframe(self, tracked: _Tracked, row: int, d_pose: Array, covariance: Array) -> Keyframe:
        """Return the keyframe in a row, with the motion to it from the one before."""
        motions, sweeps, odometry, contradicted = tracked
        stamp = float(motions.stamps[row])
        return Keyframe(
            id=self._keyframes,
            stamp=float(sweeps.columns.stamps[row]),
            motion=Increment(stamp, d_pose, covariance, self._duration),
            odometry=odometry[row],
            T_keyframe_stamp=sweeps.T_middle_stamp[row],
            stamp_covariance=sweeps.stamp_covariance[row],
            sweeps=sweeps,
            row=row,
            contradicted=bool(contradicted[row]),
        )


@kernel
def _keyframes(d_pose: Array, duration: Array, limits: Array, travelled: Array) -> Mask:
    """Tell which sweeps are keyframes; travelled (3,) m, rad, s since the last one is carried on.

    Limits of inf end nothing.
    """
    out = np.zeros(len(d_pose), np.bool_)
    for k in range(len(d_pose)):
        travelled[0] += math.hypot(d_pose[k, 0], d_pose[k, 1])
        travelled[1] += abs(d_pose[k, 2])
        travelled[2] += duration[k]
        if (travelled >= limits).any():
            out[k] = True
            travelled[:] = 0.0
    return out


@kernel
def _dead_reckon(start: Array, d_pose: Array, T_middle_stamp: Array) -> tuple[Array, Array]:
    """Return the poses (m, 3) of odometry at the middles of m sweeps, and at their stamps."""
    middles, stamps = np.empty((len(d_pose), 3)), np.empty((len(d_pose), 3))
    pose = start.copy()
    for k in range(len(d_pose)):
        advance_pose(pose, d_pose[k])
        middles[k] = stamps[k] = pose
        advance_pose(stamps[k], T_middle_stamp[k])
    return middles, stamps


@kernel
def _accumulate(
    T: Array,
    spread: Array,
    d_pose: Array,
    covariance: Array,
    T_middle_stamp: Array,
    stamp_covariance: Array,
) -> tuple[Array, Array, Array, Array]:
    """Compose m motions onto (T, spread): poses and covariances at the middles, and at the stamps."""
    m = len(d_pose)
    poses, spreads = np.empty((m, 3)), np.empty((m, 3, 3))
    at_stamp, spreads_at_stamp = np.empty((m, 3)), np.empty((m, 3, 3))
    pose, P = T.copy(), spread.copy()
    for k in range(m):
        advance(pose, P, d_pose[k], covariance[k])
        poses[k], spreads[k] = pose, P
        at_stamp[k], spreads_at_stamp[k] = pose, P
        advance(at_stamp[k], spreads_at_stamp[k], T_middle_stamp[k], stamp_covariance[k])
    return poses, spreads, at_stamp, spreads_at_stamp
