"""A gyro beside the wheels: it measures turns, which the wheels infer from rolling without slip.

Each motion's turn is corrected by that of the gyro between the same two stamps, a Kalman update of
[x, y, theta] with a scalar measurement. Where the two disagree beyond their noise, the wheels slip or
the robot is pushed: the heading follows the gyro, and the way becomes as uncertain as slip makes it.

The gyro's bias is learned while the robot stands, where the wheels know the turn without error. On the
way they do not: a track that is 10 % off would count as bias in every turn. Until the gyro has shown that
it turns as the wheels do, in sign and in unit, it is not used: a log seldom tells how it is mounted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.odometry.standstill import SECONDS
from impslam.parameters import Parameters, parameter
from impslam.types import Array, Ints

GAP = 0.25
"""s; a gyro that is silent for longer does not tell the turn in between."""
WINDOW = 1.0
"""s of motion over which the turns of wheels and gyro are compared; some hundred readings."""
SIGMAS2 = 16.0
"""Four standard deviations, squared: beyond, two turns contradict each other."""
MOVED2 = 180.0
"""The same where the wheels stand: six standard deviations, so that hours at rest move nothing, of a turn
2 r1 - r0, extrapolated at the rate r1 where it was r0 before: five times the variance of one reading."""
EVIDENCE = 16.0
"""Difference of chi-square between a gyro that turns as the wheels do and one that is not related to
them, beyond which it is used: odds of e^8 = 3000."""
MOST = 9.0
"""Chi-square that one window can contribute to that difference, so that no single slip decides."""
SMOOTHED = 0.25
"""s; the wheels' variance is averaged over this time. That of a single reading goes with the encoder's step
that falls into it, and a gain that does so as well loses part of the turn."""
CORRELATED = 20.0
"""s; the error of the bias is the same for as long as this at least; scans correct the heading sooner. The
variance of the turn grows per second as if it were drawn anew in each such time."""

# State: heading (rad), stamp and rate of the newest reading, bias, its variance, heading at the end of the
# last motion; sums over the window: duration, turns of wheels and gyro, variance; chi-squares of the three
# relations; for how long the wheels have stood (s), heading where that time began; variance per second
# of the wheels' turns.
HEADING, STAMP, RATE, BIAS, VARIANCE, BEFORE = range(6)
DURATION, WHEELS, GYRO, SUM = range(6, 10)
NONE, SAME, OPPOSED, STILL, MARK, SPREAD = range(10, 16)
STATE = 16


class Gyro(Parameters):
    """The gyro of an inertial unit beside the wheels, about the vertical axis."""

    use: bool = parameter(
        False, "", "whether turns are corrected by the log's gyro, if there is one"
    )
    stream: str = parameter("", "", "the stream of `Imu` that it reads; empty: the first one")
    proven: bool = parameter(
        False, "", "whether its axis and unit are known; else it must first turn as the wheels do"
    )
    upside_down: bool = parameter(False, "", "whether its z axis points down")
    noise: float = parameter(
        6e-4, "rad/sqrt(s)", "random walk of the heading: 0.03 deg/s/sqrt(Hz), consumer MEMS", gt=0
    )
    bias: float = parameter(
        0.02, "rad/s", "standard deviation of the constant error at start, 1 deg/s", gt=0
    )
    bias_walk: float = parameter(
        1e-5, "rad/s/sqrt(s)", "how the bias drifts: 20 deg/h in 100 s, with temperature", ge=0
    )
    scale: float = parameter(
        0.01, "rad/sqrt(rad)", "error of the scale, per root radian of turn", ge=0
    )


class Disagreement(NamedTuple):
    """A window of `WINDOW` s in which wheels and gyro turn differently: stamp, s, and both turns, rad."""

    stamp: float
    wheels: float
    gyro: float


class GyroFusion:
    """Corrects the turns of motions by the readings of a gyro, batch by batch."""

    def __init__(self, gyro: Gyro, lever: float) -> None:
        """`lever` is how far the robot goes, m, when a slipping wheel turns it by 1 rad."""
        self._gyro, self._lever = gyro, lever
        self._state = np.zeros(STATE)
        self._state[[STAMP, RATE, BEFORE, MARK]] = np.nan
        self._state[VARIANCE] = gyro.bias**2
        self._state[NONE] = 2.0 * EVIDENCE if gyro.proven else 0.0

    @property
    def trusted(self) -> bool:
        """Whether the gyro has shown that it turns as the wheels do."""
        return bool(_trusted(self._state))

    @property
    def bias(self) -> tuple[float, float]:
        """The gyro's bias and its standard deviation, rad/s."""
        return float(self._state[BIAS]), math.sqrt(self._state[VARIANCE])

    def correct(
        self, order: Ints, motions: Motions, readings: Columns | None, stamps: Array
    ) -> tuple[Motions, list[Disagreement]]:
        """Return the motions with corrected turns, and where wheels and gyro disagree.

        Parameters
        ----------
        order : (m,) positions in the log of the rows that the motions lead to
        motions : (m,) on the common time line; NaN stays as it is
        readings : the gyro's rows of the same batch; a motion uses those before it in the log
        stamps : (n,) s of those rows on the common time line
        """
        rates = np.empty(0) if readings is None else readings["angular_velocity"][:, 2]
        rows = np.empty(0, np.int64) if readings is None else readings.order
        rates = -rates if self._gyro.upside_down else np.ascontiguousarray(rates)
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        apart = np.full((len(order), 2), np.nan)
        noise = np.array([
            self._gyro.noise**2, self._gyro.bias_walk**2, self._gyro.scale**2, self._lever**2
        ])  # fmt: skip
        given = (order, motions.stamps, motions.duration)
        _correct(self._state, given, (rows, stamps, rates), noise, (d_pose, covariance, apart))
        found = [
            Disagreement(float(motions.stamps[k]), *map(float, apart[k]))
            for k in np.flatnonzero(~np.isnan(apart[:, 0]))
        ]
        return motions._replace(d_pose=d_pose, covariance=covariance), found

    def refusal(self) -> str:
        """Return one line that says why the gyro was not used although the robot turned; else empty."""
        if self.trusted or self._state[NONE] < 4.0 * EVIDENCE or np.isnan(self._state[STAMP]):
            return ""
        if self._state[NONE] - self._state[OPPOSED] > EVIDENCE:
            flipped = str(not self._gyro.upside_down).lower()
            return (
                "the gyro turns against the wheels and is not used: set "
                f"odometry.gyro.upside_down={flipped}, or swap the wheels if they are the wrong way round"
            )
        return (
            "the gyro does not turn as the wheels do and is not used: check that its z axis is "
            "vertical and its unit rad/s, or set odometry.gyro.use=false"
        )


@kernel
def _trusted(state: Array) -> bool:
    return bool(state[NONE] - state[SAME] > EVIDENCE)


@kernel
def _read(state: Array, stamp: float, rate: float) -> None:
    """Add a reading: the mean rate since the reading before."""
    if not math.isfinite(rate):
        return
    since = stamp - state[STAMP]
    if math.isnan(since) or since > GAP:
        state[BEFORE], state[MARK] = math.nan, math.nan  # the turn in between is not known
    elif since > 0.0:
        state[HEADING] += rate * since
    state[STAMP] = stamp if math.isnan(since) else max(stamp, state[STAMP])
    state[RATE] = rate


@kernel
def _heading(state: Array, stamp: float) -> float:
    """Return the gyro's heading at a stamp near its newest reading, at the rate of that; else NaN."""
    since = stamp - state[STAMP]
    if abs(since) <= GAP:
        return float(state[HEADING] + state[RATE] * since)
    return math.nan


@kernel
def _compare(state: Array, wheels: float, gyro: float, variance: float, dt: float) -> bool:
    """Add a motion to the window; return whether it is full."""
    state[DURATION] += dt
    state[WHEELS] += wheels
    state[GYRO] += gyro
    state[SUM] += variance
    return bool(state[DURATION] >= WINDOW)


@kernel
def _judge(state: Array, apart: Array) -> None:
    """Close the window: add to the evidence, and report turns (2,) that contradict each other."""
    wheels, gyro = state[WHEELS], state[GYRO] - state[BIAS] * state[DURATION]
    variance = state[SUM] + state[VARIANCE] * state[DURATION] ** 2
    state[NONE] += min(wheels**2 / variance, MOST)
    state[SAME] += min((wheels - gyro) ** 2 / variance, MOST)
    state[OPPOSED] += min((wheels + gyro) ** 2 / variance, MOST)
    if _trusted(state) and (wheels - gyro) ** 2 > SIGMAS2 * variance:
        apart[0], apart[1] = wheels, gyro
    state[DURATION : SUM + 1] = 0.0


@kernel
def _stand(state: Array, still: bool, noise: float, dt: float) -> bool:
    """Learn the bias from a robot that stands, every `SECONDS`; return whether it does.

    The heading's change over that time is used as a whole: the rate that extrapolates it to a
    motion's end is wrong by as much at the next motion, the other way.
    """
    if not still:
        state[STILL], state[MARK] = 0.0, math.nan
        return False
    state[STILL] += dt
    if state[STILL] < SECONDS:
        return False
    since = state[STILL] - SECONDS
    if since >= SECONDS and math.isfinite(state[MARK]):
        error = state[BEFORE] - state[MARK] - state[BIAS] * since
        S = noise * since + state[VARIANCE] * since**2
        if error**2 <= SIGMAS2 * S:  # else somebody turns the robot
            gain = state[VARIANCE] * since / S
            state[BIAS] += gain * error
            state[VARIANCE] -= gain * since * state[VARIANCE]
    if since >= SECONDS or math.isnan(state[MARK]):
        state[STILL], state[MARK] = SECONDS, state[BEFORE]
    return True


@kernel
def _update(d_pose: Array, P: Array, innovation: float, wheels: float, gyro: float) -> None:
    """Correct a motion (3,) and its covariance (3, 3) by the gyro's turn less its own.

    `wheels` and `gyro` are the variances that the gain rests on. The covariance is updated in the form that
    holds for any gain (Joseph), with the motion's own variance.
    """
    if innovation**2 > SIGMAS2 * (wheels + gyro):  # the wheels do not tell how the robot turns
        wheels += innovation**2
        P[2, 2] += innovation**2
    gain = wheels / (wheels + gyro) * (P[:, 2] / P[2, 2] if P[2, 2] > 0.0 else np.zeros(3))
    gain[2] = wheels / (wheels + gyro)
    d_pose += gain * innovation
    d_pose[2] = wrap_in_kernel(d_pose[2])
    A = np.eye(3)
    A[:, 2] -= gain
    P[:] = A @ P @ A.T + gyro * np.outer(gain, gain)


@kernel
def _fuse(
    state: Array, d_pose: Array, P: Array, dt: float, turn: float, noise: Array, apart: Array
) -> None:
    """Correct a motion (3,) of `dt` s and its covariance (3, 3) by the gyro's `turn`, bias included."""
    state[VARIANCE] += noise[1] * dt
    state[SPREAD] += min(dt / SMOOTHED, 1.0) * (P[2, 2] / dt - state[SPREAD])
    still = d_pose[0] == 0.0 and d_pose[2] == 0.0 and P[2, 2] == 0.0
    standing = _stand(state, still, noise[0], dt)
    variance = noise[0] * dt + noise[2] * abs(turn)
    if _compare(state, d_pose[2], turn, P[2, 2] + variance, dt):
        _judge(state, apart)
        if math.isfinite(apart[0]):
            slip2 = noise[3] * (apart[0] - apart[1]) ** 2
            P[0, 0] += slip2
            P[1, 1] += slip2
    if _trusted(state):
        variance += state[VARIANCE] * dt * max(CORRELATED, dt)
        innovation = wrap_in_kernel(turn - state[BIAS] * dt - d_pose[2])
        if not standing or innovation**2 > MOVED2 * variance:
            _update(d_pose, P, innovation, state[SPREAD] * dt, variance)


@kernel
def _correct(
    state: Array,
    motions: tuple[Ints, Array, Array],
    readings: tuple[Ints, Array, Array],
    noise: Array,
    out: tuple[Array, Array, Array],
) -> None:
    """Process motions (order, stamps, durations) and readings (order, stamps, rates) in log order."""
    order, stamps, durations = motions
    rows, times, rates = readings
    d_pose, covariance, apart = out
    j = 0
    for k in range(len(order)):
        while j < len(rows) and rows[j] < order[k]:
            _read(state, times[j], rates[j])
            j += 1
        before, state[BEFORE] = state[BEFORE], _heading(state, stamps[k])
        turn = state[BEFORE] - before
        if not (math.isnan(d_pose[k, 0]) or math.isnan(turn)) and durations[k] > 0.0:
            _fuse(state, d_pose[k], covariance[k], durations[k], turn, noise, apart[k])
    while j < len(rows):
        _read(state, times[j], rates[j])
        j += 1
