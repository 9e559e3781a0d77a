"""Check odometry's configured lengths during a run: wheels wear, tyres lose air, tracks get bent.

The motion of each stretch by the estimate is compared with that by odometry (see `agreement`). Only the
newest stretches count, so that memory is bounded and wear is detected. With a the distance scale, d the
turn scale, c the turn per metre, and the configured mean radius r, track w and ratio q of the right wheel
to the left one, the wheels have

    r / a,    w d / a,    q (1 - c w / 2 a) / (1 + c w / 2 a), about q (1 - c w / a).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from impslam.calibration.odometry_models import is_calibrated
from impslam.diagnosis.agreement import Agreement, fit_agreement
from impslam.diagnosis.finding import ERROR_RATE
from impslam.geometry.se2 import between, compose, log
from impslam.health import SLIPPED
from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.odometry.encoders import Encoders
from impslam.robot import Robot
from impslam.sources.base import Problems
from impslam.types import Array

KIND = "odometry off"
STRETCH_DURATION = 3.0
"""s: a metre or a radian of most robots, a hundred times the error of a pose in a map. If stretches ended
after a distance or a turn, more of them would end within turns than begin there, and a late clock would
look like a scale."""
MIN_MOTION = 0.02
"""m or rad of a stretch that is used."""
MAX_STRETCHES = 200
"""Stretches that are compared: ten minutes of driving."""
MIN_STRETCHES, MIN_NEW_SHARE = 16, 0.2
"""Stretches before the first comparison, and the share of new ones before each further one."""
MIN_SQUARES = 3.0
"""m^2 or rad^2, sum of squares needed for a scale: with errors of the estimate of 1 cm and 0.5 degrees per
stretch, it is then less than 0.7 % too small (regression dilution)."""
MIN_EFFECTIVE = 6.0
"""Effective number of stretches (Kish 1965) needed for a scale: with fewer, an error in one of them, such
as a scan with a late stamp, would look like a scale."""
MIN_CHANGE = 0.01
"""Share of a length that is reported, about the accuracy of a ruler."""
MAX_PULL = 0.025
"""rad/m of unintended turn: wheels 0.4 m apart that differ by 1 %."""
TURN_SIGMAS = 3.0
"""Standard deviations within which turns are right: if only distances are off, the ranges may be wrong."""


class ScaleEstimate(NamedTuple):
    """A number and its standard deviation, of which `sigmas` are needed to tell it from another one."""

    value: float
    sigma: float
    sigmas: float

    @property
    def is_clear(self) -> bool:
        """Whether the relative error of a length is large enough to report."""
        return self.is_beyond(MIN_CHANGE)

    def is_beyond(self, limit: float) -> bool:
        """Return whether the absolute value is significantly above a limit."""
        return abs(self.value) - self.sigmas * self.sigma > limit

    def words(self, less: str, more: str) -> str:
        """Return a share in percent, such as "2.1 ± 0.3 % smaller"."""
        size, sigma = 100.0 * abs(self.value), max(100.0 * self.sigma, 0.1)
        return f"{size:.1f} ± {sigma:.1f} % {more if self.value > 0.0 else less}"


class OdometryWatch(Observer):
    """Reports in one line if odometry's lengths differ from the config.

    Stretches count if the estimate is based on more than odometry (matched scans or re-observed landmarks)
    and wheels and scans agree.

    Attributes
    ----------
    notice : the line of the newest significant comparison; "" if there was none
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._poses: list[tuple[Array, Array]] = []  # of the stretch: estimate, odometry
        self._seconds = 0.0  # of the stretch
        self._rows: deque[Array] = deque(maxlen=MAX_STRETCHES)
        self._new = 0  # stretches since the last comparison
        self._comparisons = 0
        self.notice = ""

    @property
    def problems(self) -> Problems:
        """The notice as a problem of the run, if there is one."""
        found = Problems()
        if self.notice:
            found.add(KIND, self.notice)
        return found

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Add the motion to a keyframe; compare again after enough new stretches."""
        del path
        poses = compose(revision.poses[-1], keyframe.T_keyframe_stamp), keyframe.odometry
        if not (_is_sound(keyframe, revision) and np.isfinite(poses).all()):
            self._poses = []
            return
        self._seconds = self._seconds + keyframe.motion.duration if self._poses else 0.0
        self._poses.append(poses)
        if self._seconds >= STRETCH_DURATION:
            stretch = np.array(self._poses)
            self._add(log(between(stretch[:-1], stretch[1:])).sum(axis=0))
            self._poses, self._seconds = self._poses[-1:], 0.0

    def _add(self, stretch: Array) -> None:
        """Add a stretch (2, 3), by the estimate and by odometry; compare all if enough are new."""
        if np.abs(stretch[1, [0, 2]]).max() < MIN_MOTION:
            return
        self._rows.append(stretch)
        self._new += 1
        if len(self._rows) >= MIN_STRETCHES and self._new > MIN_NEW_SHARE * len(self._rows):
            self._new, rows = 0, np.array(self._rows)
            self.notice = self._compare(rows[:, 0, [0, 2]], rows[:, 1]) or self.notice

    def _compare(self, estimated: Array, measured: Array) -> str:
        """Return the line for motions (n, 2) by the estimate, m and rad, and (n, 3) by odometry."""
        squares = np.square(estimated)
        sums, fourth = squares.sum(axis=0), np.square(squares).sum(axis=0)
        has_distance, has_turn = (sums >= MIN_SQUARES) & (sums**2 >= MIN_EFFECTIVE * fourth)
        if not has_distance:
            return ""
        agreed = fit_agreement(estimated, measured)
        if agreed.distance.p[0] < 0.5:  # not a wrong length: `imp inspect` reports the cause
            return ""
        self._comparisons += 1
        turn = bool(has_turn) and not self._robot.gyro_turns
        estimates = _estimates(agreed, _needed_sigmas(self._comparisons))
        findings = "; ".join(self._findings(*estimates, turn=turn))
        return f"{findings}: {self._advice}" if findings else ""

    @property
    def _advice(self) -> str:
        if is_calibrated(self._robot.odometry):
            return "run `imp calibrate` on a log of this robot"
        return "check the lengths and angles in the odometry settings"

    def _findings(
        self, a: ScaleEstimate, c: ScaleEstimate, d: ScaleEstimate, *, turn: bool
    ) -> Iterator[str]:
        odometry = self._robot.odometry
        if isinstance(odometry, Encoders):
            return _of_wheels(a, c, d, odometry.track, turn=turn)
        return _of_poses(a, c, d, turn=turn)


def _is_sound(keyframe: Keyframe, revision: Revision) -> bool:
    """Return whether the keyframe's pose is based on more than odometry and continues the last one."""
    is_placed = revision.is_placed and len(revision.ids) == 1
    is_seen = keyframe.located or bool(revision.matches)
    return is_placed and is_seen and not keyframe.lost and keyframe.reason < SLIPPED


def _needed_sigmas(comparisons: int) -> float:
    """Return the standard deviations needed in the last of some comparisons.

    The error rates 6 / (pi n)^2 of all comparisons n add up to 1, times that of one test.
    """
    from statistics import NormalDist  # noqa: PLC0415  # 10 ms, and short logs need none

    rate = ERROR_RATE * 6.0 / (math.pi * comparisons) ** 2
    return -NormalDist().inv_cdf(0.5 * rate)


def _of_wheels(
    a: ScaleEstimate, c: ScaleEstimate, d: ScaleEstimate, track: float, *, turn: bool
) -> Iterator[str]:
    radius = a._replace(value=1.0 / a.value - 1.0, sigma=a.sigma / a.value**2)
    ratio = d.value / a.value
    spread = math.hypot(d.sigma, ratio * a.sigma) / a.value
    wide = d._replace(value=ratio - 1.0, sigma=spread)
    unequal = c._replace(value=-track * c.value / a.value, sigma=track * c.sigma / a.value)
    turns_fit = abs(d.value - 1.0) < TURN_SIGMAS * d.sigma
    if turn and turns_fit and radius.is_clear and wide.is_clear:
        yield (
            f"the wheels' radius and the track are {radius.words('smaller', 'larger')} than "
            "configured, or the lidar's ranges are off by as much"
        )
    else:
        if radius.is_clear:
            yield f"the wheels' radius is {radius.words('smaller', 'larger')} than configured"
        if turn and wide.is_clear:
            yield f"the track is {wide.words('narrower', 'wider')} than configured"
    if turn and unequal.is_clear:
        words = unequal.words("smaller", "larger")
        yield f"the right wheel is {words} than configured, compared with the left one"


def _of_poses(a: ScaleEstimate, c: ScaleEstimate, d: ScaleEstimate, *, turn: bool) -> Iterator[str]:
    distances, turns = a._replace(value=a.value - 1.0), d._replace(value=d.value - 1.0)
    if distances.is_clear:
        yield f"odometry's distances are {distances.words('shorter', 'longer')} than those of the map"
    if turn and turns.is_clear:
        yield f"odometry's turns are {turns.words('smaller', 'larger')} than those of the map"
    if turn and c.is_beyond(MAX_PULL):
        pull = f"{c.value:+.3f} ± {max(c.sigma, 1e-3):.3f} rad"
        yield f"odometry turns by {pull} per metre of straight driving"


def _estimates(
    agreed: Agreement, sigmas: float
) -> tuple[ScaleEstimate, ScaleEstimate, ScaleEstimate]:
    """Return the scale of distances, the turn per metre, and the scale of turns."""
    distance, turn = agreed
    return (
        ScaleEstimate(float(distance.p[0]), float(distance.sigma[0]), sigmas),
        ScaleEstimate(float(turn.p[0]), float(turn.sigma[0]), sigmas),
        ScaleEstimate(float(turn.p[1]), float(turn.sigma[1]), sigmas),
    )
