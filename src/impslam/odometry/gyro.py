"""Fuse a gyro with wheel odometry: it measures turns, which wheels only infer from rolling without slip.

The turn of each motion is corrected by that of the gyro between the same two stamps, a Kalman update of
[x, y, theta] with a scalar measurement. If the two disagree beyond their noise, the wheels slip or
the robot is pushed: the heading follows the gyro, and the distance becomes as uncertain as the slip.

The gyro's bias is learned while the robot is stationary, when the turn of the wheels is exact, but for
what they turn before their encoders' first step. While driving it is not: a track that is 10 % off would
count as bias in every turn. The gyro is not used until its turns have agreed with the wheels in sign and in
unit: a log seldom contains how it is mounted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.noise import BIAS_CORRELATION_TIME, SystematicErrors
from impslam.odometry.standstill import STANDSTILL_TIME
from impslam.parameters import Parameters, parameter
from impslam.types import Array, Ints

MAX_GAP = 0.25
"""s; after a longer gap between readings the turn in between is unknown."""
WINDOW = 1.0
"""s of motion over which the turns of wheels and gyro are compared; some hundred readings."""
GATE = 16.0
"""Four standard deviations, squared; a larger difference is a contradiction."""
STATIONARY_GATE = 180.0
"""The same for stationary wheels: six standard deviations, so that hours at rest cause no motion, of a turn
2 r1 - r0, extrapolated from the rates r0 and then r1: five times the variance of one reading."""
MIN_EVIDENCE = 16.0
"""Difference of chi-square between a gyro that is unrelated to the wheels and one that agrees, beyond
which it is used: odds of e^8 = 3000."""
MAX_WINDOW_CHI2 = 9.0
"""Largest contribution of one window to that chi-square, so that no single slip decides."""
SMOOTHING_TIME = 0.25
"""s; the wheels' variance is averaged over this time. That of a single reading depends on whether an
encoder's step falls into it, and a gain that did so, too, would lose part of the turn. The same holds for
their covariance of path and turn: by Eq. 3.19 the wheel that travels farther errs more, and in a single
reading that is the one with the larger error, so that each correction of a turn would shorten the path."""
CORRECTION_TIME = 0.5
"""s; the time for which the error of the bias counts in the gain if the filter estimates it: landmarks
correct the heading, and with it the bias, at the next keyframe."""

# Columns of the state, in s and rad.
HEADING, STAMP, RATE = 0, 1, 2  # of the newest reading
BIAS, BIAS_VARIANCE = 3, 4
LAST_HEADING = 5  # at the end of the last motion
DURATION = 6  # of the window
WHEELS, GYRO, WINDOW_VARIANCE = 7, 8, 9  # sums over the window: turns of both, and variance
CHI2_UNRELATED, CHI2_SAME, CHI2_OPPOSITE = 10, 11, 12  # of the three relations of wheels and gyro
STATIONARY_TIME = 13  # for which the wheels have been stationary
STATIONARY_HEADING = 14  # at the start of that time
WHEEL_VARIANCE = 15  # of the wheels' turns, per second
PENDING_TURN, PENDING_TIME = 16, 17  # of the interval at rest before that; 0 if there is none
PATH_COVARIANCE = 18  # of the wheels' paths and turns, per second
MOTION_STAMP = 19  # of the end of the last motion
STATE_SIZE = 20


class Gyro(Parameters):
    """The gyro of an inertial unit beside the wheels, about the vertical axis."""

    use: bool = parameter(False, "", "whether the log's gyro corrects turns, if there is one")
    stream: str = parameter("", "", "the stream of `Imu` that it reads; empty: the first one")
    proven: bool = parameter(
        False, "", "whether its axis and unit are known; else it must first agree with the wheels"
    )
    upside_down: bool = parameter(False, "", "whether its z axis points down")
    noise: float = parameter(
        6e-4, "rad/sqrt(s)", "random walk of the heading: 0.03 deg/s/sqrt(Hz), consumer MEMS", gt=0
    )
    bias: float = parameter(
        0.02, "rad/s", "standard deviation of the constant error at start, 1 deg/s", gt=0
    )
    bias_walk: float = parameter(
        1e-5, "rad/s/sqrt(s)", "drift of the bias: 20 deg/h in 100 s, with temperature", ge=0
    )
    scale: float = parameter(
        0.01, "rad/sqrt(rad)", "error of the scale, the same at 1 rad of turn", ge=0
    )


class Disagreement(NamedTuple):
    """A window of `WINDOW` s in which wheels and gyro turn differently.

    Attributes
    ----------
    order : position in the log of the row at its end
    stamp : s, of that row
    wheels, gyro : rad turned
    """

    order: int
    stamp: float
    wheels: float
    gyro: float


class GyroFusion:
    """Corrects the turns of motions by the readings of a gyro, batch by batch."""

    def __init__(
        self,
        gyro: Gyro,
        lever: float,
        band: float = 0.0,
        considered: SystematicErrors | None = None,
    ) -> None:
        """Start with the parameters of the gyro.

        Parameters
        ----------
        lever : the distance that the robot moves when a slipping wheel turns it by 1 rad, m
        band : the angle within which odometry counts as stationary, rad; 0: unknown
        considered : errors of the wheels that the covariances of motions do not contain; those of the
            gyro are then left out, too. None: all are contained as random errors
        """
        self._gyro = gyro
        self._state = np.zeros(STATE_SIZE)
        self._state[[STAMP, RATE, LAST_HEADING, STATIONARY_HEADING, MOTION_STAMP]] = np.nan
        self._state[BIAS_VARIANCE] = gyro.bias**2
        self._state[CHI2_UNRELATED] = 2.0 * MIN_EVIDENCE if gyro.proven else 0.0
        wheels = considered or SystematicErrors(0.0, 0.0)
        self._noise = np.array([
            gyro.noise**2, gyro.bias_walk**2, gyro.scale**2, lever**2, band or math.inf,
            wheels.turn_per_distance**2, wheels.turn**2,
            BIAS_CORRELATION_TIME if considered is None else CORRECTION_TIME, considered is None,
        ])  # fmt: skip

    @property
    def trusted(self) -> bool:
        """Whether the turns of the gyro have agreed with the wheels."""
        return bool(_trusted(self._state))

    @property
    def bias(self) -> tuple[float, float]:
        """The gyro's bias and its standard deviation, rad/s."""
        return float(self._state[BIAS]), math.sqrt(self._state[BIAS_VARIANCE])

    def correct(
        self, order: Ints, motions: Motions, readings: Columns | None, stamps: Array
    ) -> tuple[Motions, list[Disagreement], Array]:
        """Return the motions with corrected turns, and where wheels and gyro disagree.

        Also return the share (m,) of the gyro in each turn, NaN if it did not measure the turn, and the
        standard deviation of its bias, rad/s, 0 without readings: (m, 2).

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
        disagreement = np.full((len(order), 2), np.nan)
        shares = np.zeros((len(order), 2))
        inputs = (order, motions.stamps, motions.duration)
        outputs = (d_pose, covariance, disagreement, shares)
        _correct(self._state, inputs, (rows, stamps, rates), self._noise, outputs)
        disagreements = [
            Disagreement(int(order[k]), float(motions.stamps[k]), *map(float, disagreement[k]))
            for k in np.flatnonzero(~np.isnan(disagreement[:, 0]))
        ]
        return motions._replace(d_pose=d_pose, covariance=covariance), disagreements, shares

    def rejection(self) -> str:
        """Return one line on why the gyro was not used although the robot turned; else empty."""
        if (
            self.trusted
            or self._state[CHI2_UNRELATED] < 4.0 * MIN_EVIDENCE
            or np.isnan(self._state[STAMP])
        ):
            return ""
        if self._state[CHI2_UNRELATED] - self._state[CHI2_OPPOSITE] > MIN_EVIDENCE:
            flipped = str(not self._gyro.upside_down).lower()
            return (
                "the gyro turns against the wheels and is not used: set "
                f"odometry.gyro.upside_down={flipped}, or odometry.swapped if the wheels are swapped"
            )
        return (
            "the gyro does not turn as the wheels do and is not used: check that its z axis is "
            "vertical and its unit rad/s, or set odometry.gyro.use=false"
        )


@kernel
def _trusted(state: Array) -> bool:
    return bool(state[CHI2_UNRELATED] - state[CHI2_SAME] > MIN_EVIDENCE)


@kernel
def _read(state: Array, stamp: float, rate: float) -> None:
    """Add a reading: the mean rate since the previous reading."""
    if not math.isfinite(rate):
        return
    elapsed = stamp - state[STAMP]
    if math.isnan(elapsed) or elapsed > MAX_GAP:
        state[LAST_HEADING] = state[STATIONARY_HEADING] = math.nan  # the turn is not known
    elif elapsed > 0.0:
        state[HEADING] += rate * elapsed
    state[STAMP] = stamp if math.isnan(elapsed) else max(stamp, state[STAMP])
    state[RATE] = rate


@kernel
def _heading(state: Array, stamp: float) -> float:
    """Return the gyro's heading at a stamp near its newest reading, extrapolated at its rate; else NaN."""
    elapsed = stamp - state[STAMP]
    if abs(elapsed) <= MAX_GAP:
        return float(state[HEADING] + state[RATE] * elapsed)
    return math.nan


@kernel
def _add_to_window(state: Array, wheels: float, gyro: float, variance: float, dt: float) -> bool:
    """Add a motion to the window; return whether it is full."""
    state[DURATION] += dt
    state[WHEELS] += wheels
    state[GYRO] += gyro
    state[WINDOW_VARIANCE] += variance
    return bool(state[DURATION] >= WINDOW)


@kernel
def _close_window(state: Array, disagreement: Array) -> None:
    """Close the window: add to the evidence, and report turns (2,) that contradict each other."""
    wheels, gyro = state[WHEELS], state[GYRO] - state[BIAS] * state[DURATION]
    variance = state[WINDOW_VARIANCE] + state[BIAS_VARIANCE] * state[DURATION] ** 2
    state[CHI2_UNRELATED] += min(wheels**2 / variance, MAX_WINDOW_CHI2)
    state[CHI2_SAME] += min((wheels - gyro) ** 2 / variance, MAX_WINDOW_CHI2)
    state[CHI2_OPPOSITE] += min((wheels + gyro) ** 2 / variance, MAX_WINDOW_CHI2)
    if _trusted(state) and (wheels - gyro) ** 2 > GATE * variance:
        disagreement[0], disagreement[1] = wheels, gyro
    state[DURATION : WINDOW_VARIANCE + 1] = 0.0


@kernel
def _learn_bias(state: Array, turn: float, elapsed: float, variance: float) -> None:
    """Learn the bias from the gyro's turn in `elapsed` s at rest; `variance` is that of the turn."""
    if elapsed <= 0.0:
        return
    error = turn - state[BIAS] * elapsed
    S = variance + state[BIAS_VARIANCE] * elapsed**2
    if error**2 <= GATE * S:  # else the robot is being turned
        gain = state[BIAS_VARIANCE] * elapsed / S
        state[BIAS] += gain * error
        state[BIAS_VARIANCE] -= gain * elapsed * state[BIAS_VARIANCE]


@kernel
def _wait(state: Array, noise: float, dt: float) -> bool:
    """Add a motion of a stationary robot; return whether it has been at rest for `STANDSTILL_TIME`.

    The heading's change over an interval of that length is used as a whole: errors of extrapolating it to
    the end of successive motions cancel. An interval is used when the next one is complete, because wheels
    also read stationary until their first step: by then, the robot may have turned.
    """
    state[STATIONARY_TIME] += dt
    elapsed = state[STATIONARY_TIME] - STANDSTILL_TIME
    if elapsed < 0.0:
        return False
    if math.isnan(state[STATIONARY_HEADING]):
        state[PENDING_TURN], state[PENDING_TIME] = 0.0, 0.0
    elif elapsed >= STANDSTILL_TIME:
        _learn_bias(state, state[PENDING_TURN], state[PENDING_TIME], noise * state[PENDING_TIME])
        state[PENDING_TURN] = state[LAST_HEADING] - state[STATIONARY_HEADING]
        state[PENDING_TIME] = elapsed
    else:
        return True
    state[STATIONARY_TIME], state[STATIONARY_HEADING] = STANDSTILL_TIME, state[LAST_HEADING]
    return True


@kernel
def _start(state: Array, heading: float, hidden: float, noise: float) -> None:
    """Use what is left of a standstill that ends at `heading`, in which wheels may hide a turn.

    With fine encoders `hidden`, its largest value, is little, so a short standstill is of use.
    """
    if math.isfinite(hidden) and math.isfinite(state[STATIONARY_HEADING]):
        elapsed = state[PENDING_TIME] + state[STATIONARY_TIME] - STANDSTILL_TIME
        turn = state[PENDING_TURN] + heading - state[STATIONARY_HEADING]
        _learn_bias(state, turn, elapsed, noise * elapsed + hidden**2 / 3.0)  # uniform
    state[STATIONARY_TIME], state[STATIONARY_HEADING] = 0.0, math.nan


@kernel
def _hidden(d_pose: Array, lever2: float, band: float) -> float:
    """Return the largest turn that the wheels did not show before their first motion (3,).

    Each wheel may have moved by as much as now, but by no more than the band of a standstill, if known.
    """
    if lever2 > 0.0:
        return float(min(band, abs(d_pose[2]) + abs(d_pose[0]) / math.sqrt(lever2)))
    return band


@kernel
def _update(
    d_pose: Array,
    P: Array,
    innovation: float,
    wheels: tuple[float, float, float],
    gyro: tuple[float, float],
) -> float:
    """Correct a motion (3,) and its covariance (3, 3) by the gyro's turn minus its own; return the gain.

    `wheels` are the variance for the gain, the part of the turn's own that P does not contain, and the
    covariance of path and turn for the gain; `gyro` are the variance for the gain, and the part of it that
    P is to contain. The covariance is updated in the form that is valid for any gain (Joseph).
    """
    expected, own = wheels[0], P[2, 2] + wheels[1]
    if innovation**2 > GATE * (expected + gyro[0]):  # the wheels do not measure the robot's turn
        expected += innovation**2
        own += innovation**2
        P[2, 2] += innovation**2
    share = expected / (expected + gyro[0])
    gain = np.array([0.0, 0.0, share])
    if own > 0.0:
        gain[0], gain[1] = share * wheels[2] / own, share * (P[1, 2] / own)
    d_pose += gain * innovation
    d_pose[2] = wrap_in_kernel(d_pose[2])
    A = np.eye(3)
    A[:, 2] -= gain
    P[:] = A @ P @ A.T + gyro[1] * np.outer(gain, gain)
    return share


@kernel
def _fuse(
    state: Array, d_pose: Array, P: Array, dt: float, turn: float, noise: Array, disagreement: Array
) -> float:
    """Correct a motion (3,) of `dt` s and its covariance (3, 3) by the gyro's `turn`, bias included.

    Return the share of the gyro in the corrected turn.
    """
    state[BIAS_VARIANCE] += noise[1] * dt
    systematic = noise[5] * math.hypot(d_pose[0], d_pose[1]) + noise[6] * abs(d_pose[2])
    wheels = P[2, 2] + systematic
    weight = min(dt / SMOOTHING_TIME, 1.0)
    path = state[PATH_COVARIANCE] * dt  # up to the reading before, whose errors are independent
    state[WHEEL_VARIANCE] += weight * (wheels / dt - state[WHEEL_VARIANCE])
    state[PATH_COVARIANCE] += weight * (P[0, 2] / dt - state[PATH_COVARIANCE])
    stationary = d_pose[0] == 0.0 and d_pose[2] == 0.0 and P[2, 2] == 0.0
    if stationary:
        learning = _wait(state, noise[0], dt)
    else:
        learning = False
        hidden = _hidden(d_pose, noise[3], noise[4])
        _start(state, state[LAST_HEADING] - turn, hidden, noise[0])
    random = noise[0] * dt
    variance = random + noise[2] * abs(turn)
    if _add_to_window(state, d_pose[2], turn, wheels + variance, dt):
        _close_window(state, disagreement)
        if math.isfinite(disagreement[0]):
            slip2 = noise[3] * (disagreement[0] - disagreement[1]) ** 2
            P[0, 0] += slip2
            P[1, 1] += slip2
    if _trusted(state):
        variance += state[BIAS_VARIANCE] * dt * max(noise[7], dt)
        innovation = wrap_in_kernel(turn - state[BIAS] * dt - d_pose[2])
        if not learning or innovation**2 > STATIONARY_GATE * variance:
            kept = variance if noise[8] > 0.0 else random
            expected = state[WHEEL_VARIANCE] * dt
            return _update(d_pose, P, innovation, (expected, systematic, path), (variance, kept))
    return 0.0


@kernel
def _correct(
    state: Array,
    motions: tuple[Ints, Array, Array],
    readings: tuple[Ints, Array, Array],
    noise: Array,
    out: tuple[Array, Array, Array, Array],
) -> None:
    """Process motions (order, stamps, durations) and readings (order, stamps, rates) in log order."""
    order, stamps, durations = motions
    rows, times, rates = readings
    d_pose, covariance, disagreement, shares = out
    j = 0
    for k in range(len(order)):
        while j < len(rows) and rows[j] < order[k]:
            _read(state, times[j], rates[j])
            j += 1
        before, state[LAST_HEADING] = state[LAST_HEADING], _heading(state, stamps[k])
        turn = state[LAST_HEADING] - before
        elapsed, state[MOTION_STAMP] = stamps[k] - state[MOTION_STAMP], stamps[k]
        if math.isnan(turn) or durations[k] - elapsed > MAX_GAP:  # a gap, or a clock that was set
            shares[k, 0] = math.nan
        elif not math.isnan(d_pose[k, 0]) and durations[k] > 0.0:
            shares[k, 0] = _fuse(
                state, d_pose[k], covariance[k], durations[k], turn, noise, disagreement[k]
            )
        if not math.isnan(state[STAMP]):
            shares[k, 1] = math.sqrt(state[BIAS_VARIANCE])
    while j < len(rows):
        _read(state, times[j], rates[j])
        j += 1
