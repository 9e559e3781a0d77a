"""Settings, input and state of scan matching; kernels change the state in place."""

from __future__ import annotations

from typing import NamedTuple

from impslam.surfaces.surface_map import Alignment, FitSums
from impslam.tracking.jump import PastScans
from impslam.tracking.learned_odometry import LearnedOdometry
from impslam.tracking.match_faults import MatchFaults, MatchQuality
from impslam.tracking.stall import StallState
from impslam.tracking.submaps import Submaps
from impslam.types import Array, Ints, Mask

DISTANCE, TURN, SECONDS = range(3)  # of `State.travelled`
POSITION, HEADING = range(2)  # of `State.prior`, `slip` and `reach`
SHARE, SQUARE, INTERVAL = range(3)  # of `State.averages`


class Settings(NamedTuple):
    """Parameters of scan matching; see `ScanToMap`."""

    match: Alignment
    length: float
    spacing: float
    turn: float
    thin: float
    smooth: bool
    drift: Array


class LidarState(NamedTuple):
    """The last scans of one lidar.

    Attributes
    ----------
    ranges : (n,) m, of its newest matched scan; 0 where invalid
    pose : (3,) of base_link at that scan, in the frame of the submaps
    added : (3,) pose of its newest scan in the submaps; NaN before the first
    past : its last scans, to compare with the next ones
    stall : whether the robot stands although its wheels turn
    """

    ranges: Array
    pose: Array
    added: Array
    past: PastScans
    stall: StallState


class FrozenOdometry(NamedTuple):
    """Whether odometry stands still while the robot moves.

    Attributes
    ----------
    is_frozen : (1,) whether it does
    distance : (1,) m that the robot may have gone since it last moved by odometry, while no scan determined
        its position
    speed : (1,) m/s when it last moved by odometry
    """

    is_frozen: Mask
    distance: Array
    speed: Array


class State(NamedTuple):
    """State of the tracker; kernels change all of it in place.

    Attributes
    ----------
    submaps, odometry : the last metres, and the learned bias and noise of odometry
    pose, matched : (3,) in the frame of the submaps: now, and at the newest match
    motion, covariance : (3,), (3, 3) by odometry since the newest match, without its learned bias
    reported : (1,) rad, the turn of that motion with the bias
    error : (3, 3) covariance of `matched` in the submaps, as far as it differs from that of the newest
        keyframe; without `drift`
    travelled : (3,) m, rad and s of that motion
    stamp : (1,) s, middle of the newest sweep; NaN before the first
    interval : (2,) s from the sweep before it, by odometry and by the stamps; NaN before the second
    intervals : (3,) statistics of those by odometry; see `no_intervals`
    velocity : (3,) motion between the last two matches; without odometry, only as far as normals cannot
        have caused it
    prior : (2,) variances of the predicted pose: m^2 along each axis, rad^2
    slip : (2,) what is added to them for the match while wheels slip
    reach : (2,) m, rad around the predicted pose in which the robot may be, after a gap that odometry does
        not cover, until a scan is matched; else 0
    frozen : whether odometry is frozen
    unlocated : (1,) s since a scan last determined the velocity of a robot without odometry
    averages : (3,) running means of the inlier share, of the squared distance, m^2, and of the time
        between sweeps without odometry, s
    evidence : of the newest match
    faults : whether the newest scans fit the submaps
    time : (1,) s since the first scan
    places : (1,) number of times that new maps have begun elsewhere
    proven : (1,) share of the beams that prove that the robot was carried, until a match reports it; else 0
    lidar : the last scans of the lidar whose sweeps are followed
    """

    submaps: Submaps
    odometry: LearnedOdometry
    pose: Array
    matched: Array
    motion: Array
    covariance: Array
    reported: Array
    error: Array
    travelled: Array
    stamp: Array
    interval: Array
    intervals: Array
    velocity: Array
    prior: Array
    slip: Array
    reach: Array
    frozen: FrozenOdometry
    unlocated: Array
    averages: Array
    evidence: FitSums
    faults: MatchFaults
    time: Array
    places: Ints
    proven: Array
    lidar: LidarState


class ScanMatch(NamedTuple):
    """The pose that fits a sweep best.

    Attributes
    ----------
    guess : (3,) the predicted pose
    fit : how the sweep fits the submaps
    usual : mean inlier share so far
    H, W : (3, 3), (3,) information of the scan, and of the prior with its robust weight
    """

    guess: Array
    fit: MatchQuality
    usual: float
    H: Array
    W: Array
