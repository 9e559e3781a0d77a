"""Watches during a run whether odometry's lengths still hold: wheels wear, tyres lose air, tracks are bent.

The motion of each stretch by the estimate is compared with that by odometry (`agreement`), over the
newest stretches alone, so that memory is bounded and wear shows. With a the scale of odometry's ways, d
that of its turns, c its turn per metre, and the configured mean radius r, track w and ratio q of the right
wheel to the left one, the wheels have

    r / a,    w d / a,    q (1 - c w / 2 a) / (1 + c w / 2 a), about q (1 - c w / a).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from impslam.calibration.odometry_models import is_calibrated
from impslam.diagnosis.agreement import Agreement, agreement
from impslam.geometry.se2 import between, compose, log
from impslam.health import SLIPPED
from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.odometry.encoders import Encoders
from impslam.robot import Robot
from impslam.sources.base import Problems
from impslam.types import Array

KIND = "odometry off"
SECONDS = 3.0
"""s of a stretch: a metre or a radian of most robots, a hundred times what a pose in a map is off by. If
stretches ended after a way or a turn, more of them would end within turns than begin there, and a clock
that is late would look like a scale."""
MOVED = 0.02
"""m or rad, the least of a stretch that tells anything."""
NEWEST = 200
"""Stretches that are compared: ten minutes of driving."""
FEWEST, MORE = 16, 0.2
"""Stretches before the first comparison, and the share of new ones from which on another is worth it."""
EXCITED = 3.0
"""m^2 or rad^2, the least sum of squares that tells a scale: errors of the estimate, 1 cm and 0.5 degrees
a stretch, make it less than 0.7 % too small then (regression dilution)."""
CARRIERS = 6.0
"""Stretches that a scale rests on at least (Kish's effective number, 1965): what is off in one of a few,
such as a scan that is stamped late, would pass for a scale."""
LEAST, SIGMAS = 0.01, 4.0
"""Share of a length that counts, a ruler tells no less; and how many standard deviations beyond it are
needed: ten minutes of driving make some tens of comparisons."""
PULL = 0.025
"""rad/m of turn that nobody has asked for: wheels 0.4 m apart that differ by 1 %."""
RANGES = 3.0
"""Standard deviations within which turns are right: ways that alone are off may be the lidar's error."""


class Estimate(NamedTuple):
    """A number and its standard deviation."""

    value: float
    sigma: float

    @property
    def is_clear(self) -> bool:
        """Whether a share by which a length is off is surely worth saying."""
        return self.is_beyond(LEAST)

    def is_beyond(self, limit: float) -> bool:
        """Tell whether its size is surely more than a limit."""
        return abs(self.value) - SIGMAS * self.sigma > limit

    def words(self, less: str, more: str) -> str:
        """Return a share in percent, "2.1 ± 0.3 % smaller"."""
        size, sigma = 100.0 * abs(self.value), max(100.0 * self.sigma, 0.1)
        return f"{size:.1f} ± {sigma:.1f} % {more if self.value > 0.0 else less}"


class OdometryWatch(Observer):
    """Says in one line when odometry's lengths are not those of the config.

    Stretches count where the estimate rests on more than odometry: scans that were matched, or
    landmarks that were seen again, while wheels and scans agree.

    Attributes
    ----------
    notice : the line, as of the newest comparison that was clear; "" as long as there was none
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._poses: list[
            tuple[Array, Array]
        ] = []  # of the stretch, by the estimate and by odometry
        self._seconds = 0.0  # of the stretch
        self._rows: deque[Array] = deque(maxlen=NEWEST)
        self._new = 0  # stretches since the last comparison
        self.notice = ""

    @property
    def problems(self) -> Problems:
        """The notice as a problem of the run, if there is one."""
        found = Problems()
        if self.notice:
            found.add(KIND, self.notice)
        return found

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Add the motion to a keyframe; compare, once there are some stretches more."""
        del path
        poses = compose(revision.poses[-1], keyframe.T_keyframe_stamp), keyframe.odometry
        if not (_is_sound(keyframe, revision) and np.isfinite(poses).all()):
            self._poses = []
            return
        self._seconds = self._seconds + keyframe.motion.duration if self._poses else 0.0
        self._poses.append(poses)
        if self._seconds >= SECONDS:
            stretch = np.array(self._poses)
            self._add(log(between(stretch[:-1], stretch[1:])).sum(axis=0))
            self._poses, self._seconds = self._poses[-1:], 0.0

    def _add(self, stretch: Array) -> None:
        """Add a stretch (2, 3), by the estimate and by odometry; compare all, if it is time."""
        if np.abs(stretch[1, [0, 2]]).max() < MOVED:
            return
        self._rows.append(stretch)
        self._new += 1
        if len(self._rows) >= FEWEST and self._new > MORE * len(self._rows):
            self._new, rows = 0, np.array(self._rows)
            self.notice = self._compare(rows[:, 0, [0, 2]], rows[:, 1]) or self.notice

    def _compare(self, moved: Array, told: Array) -> str:
        """Return the line for motions (n, 2) by the estimate, m and rad, and (n, 3) by odometry."""
        squares = np.square(moved)
        sums, fourth = squares.sum(axis=0), np.square(squares).sum(axis=0)
        way, turn = (sums >= EXCITED) & (sums**2 >= CARRIERS * fourth)
        if not way:
            return ""
        agreed = agreement(moved, told)
        if agreed.way.p[0] < 0.5:  # no length, but another way to be wrong: `imp inspect` tells it
            return ""
        found = "; ".join(self._findings(agreed, turn=bool(turn) and not self._robot.gyro_turns))
        return f"{found}: {self._advice}" if found else ""

    @property
    def _advice(self) -> str:
        if is_calibrated(self._robot.odometry):
            return "run `imp calibrate` on a log of this robot"
        return "check the lengths and angles that odometry is told"

    def _findings(self, agreed: Agreement, *, turn: bool) -> Iterator[str]:
        odometry = self._robot.odometry
        if isinstance(odometry, Encoders):
            return _of_wheels(agreed, odometry.track, turn=turn)
        return _of_poses(agreed, turn=turn)


def _is_sound(keyframe: Keyframe, revision: Revision) -> bool:
    """Tell whether the keyframe's pose rests on more than odometry, and continues the one before."""
    is_placed = bool(np.ravel(revision.placed)[-1]) and len(revision.ids) == 1
    is_seen = keyframe.located or bool(revision.matches)
    return is_placed and is_seen and not keyframe.lost and keyframe.reason < SLIPPED


def _of_wheels(agreed: Agreement, track: float, *, turn: bool) -> Iterator[str]:
    a, c, d = _parameters(agreed)
    radius = Estimate(1.0 / a.value - 1.0, a.sigma / a.value**2)
    ratio = d.value / a.value
    wide = Estimate(ratio - 1.0, ratio * math.hypot(d.sigma / d.value, a.sigma / a.value))
    unequal = Estimate(-track * c.value / a.value, track * c.sigma / a.value)
    turns_fit = abs(d.value - 1.0) < RANGES * d.sigma
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


def _of_poses(agreed: Agreement, *, turn: bool) -> Iterator[str]:
    a, c, d = _parameters(agreed)
    ways, turns = a._replace(value=a.value - 1.0), d._replace(value=d.value - 1.0)
    if ways.is_clear:
        yield f"odometry's ways are {ways.words('shorter', 'longer')} than those of the map"
    if turn and turns.is_clear:
        yield f"odometry's turns are {turns.words('smaller', 'larger')} than those of the map"
    if turn and c.is_beyond(PULL):
        pull = f"{c.value:+.3f} ± {max(c.sigma, 1e-3):.3f} rad"
        yield f"odometry turns by {pull} per metre of straight way"


def _parameters(agreed: Agreement) -> tuple[Estimate, Estimate, Estimate]:
    """Return a, c and d."""
    way, turn = agreed
    return (
        Estimate(float(way.p[0]), float(way.sigma[0])),
        Estimate(float(turn.p[0]), float(turn.sigma[0])),
        Estimate(float(turn.p[1]), float(turn.sigma[1])),
    )
