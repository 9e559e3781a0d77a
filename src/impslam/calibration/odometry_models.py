"""Dead reckoning as a function of the calibrated parameters, with derivatives, over a whole log at once.

A reading adds a step: a path w (complex, x + i y) driven at a constant rate while the robot turns by a, so
its chord is w exp(i a/2) sin(a/2)/(a/2) (SE(2), as in `odometry`). With headings h and positions X
accumulated over all steps, the motion between two times is z = exp(-i h_a) (X_b - X_a), with the turn
h_b - h_a; the derivatives of X by the parameters are sums of the same kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.columns import Columns
from impslam.errors import ConfigError
from impslam.geometry.se2 import between, log
from impslam.odometry.base import Odometry
from impslam.odometry.encoders import Encoders
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.odometry.velocity import Velocities
from impslam.types import Array, Mask

Complex: TypeAlias = npt.NDArray[np.complex128]


WINDOW = 0.1
"""s on either side of a time over which speeds are averaged."""


class MotionSteps(NamedTuple):
    """m steps and their derivatives by p parameters.

    Attributes
    ----------
    path : (m,) complex, m forward + i to the left
    turn : (m,) rad
    path_D, turn_D : (m, p)
    """

    path: Complex
    turn: Array
    path_D: Complex
    turn_D: Array


class OdometryModel(Protocol):
    """The readings of one log, and their conversion to steps for given parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """The p parameters, keys of the config's table `odometry`."""

    @property
    def stamps(self) -> Array:
        """(m + 1,) s, non-decreasing."""

    @property
    def unknown(self) -> Mask:
        """(m,) steps whose motion is unknown."""

    def steps(self, values: Array) -> MotionSteps:
        """Return the steps for parameters (p,)."""

    def turn_inputs(self) -> Array:
        """Return the readings (m, 1 or 2) of which the turns are a linear function."""

    def parameters(self, turning: Array, scale: float) -> Array:
        """Return parameters (p,) for the factors (2,) of `turn_inputs` and a distance scale."""

    def wheel_turns(self) -> tuple[Array, Array]:
        """Return the readings (m,) of the left and the right wheel, per step; zeros without wheels."""


@dataclass(frozen=True, eq=False)
class DifferentialDrive:
    """Two wheels with encoders: turning by l and r rad, they drive a distance (R l + q R r) / 2.

    The robot turns by (q R r - R l) / b, with R the left wheel's radius, q R the right one's, b the track.
    """

    names: ClassVar[tuple[str, ...]] = ("wheel_radius", "right_left_ratio", "track")
    stamps: Array
    unknown: Mask
    left: Array
    right: Array

    def steps(self, values: Array) -> MotionSteps:
        """Return the steps; see `OdometryModel.steps`."""
        radius, ratio, track = values
        left, right, zero = self.left, ratio * self.right, np.zeros_like(self.left)
        path, turn = 0.5 * radius * (left + right), radius * (right - left) / track
        path_D = (0.5 * (left + right), 0.5 * radius * self.right, zero)
        turn_D = ((right - left) / track, radius * self.right / track, -turn / track)
        return MotionSteps(path + 0j, turn, np.column_stack(path_D) + 0j, np.column_stack(turn_D))

    def turn_inputs(self) -> Array:
        """Return the turns of both wheels."""
        return np.column_stack((self.left, self.right))

    def parameters(self, turning: Array, scale: float) -> Array:
        """Return radius, ratio and track; the track is the scale."""
        return np.array([-turning[0] * scale, -turning[1] / turning[0], scale])

    def wheel_turns(self) -> tuple[Array, Array]:
        """Return the turns of both wheels."""
        return self.left, self.right


@dataclass(frozen=True, eq=False)
class ScaledTwists:
    """Odometry that measures motions: twists (m, 3), each over its step.

    The first parameter scales distances, the second turns; the third, if there is one, adds a turn per
    metre, as caused by wheels of unequal size.
    """

    names: tuple[str, ...]
    stamps: Array
    unknown: Mask
    twists: Array

    def steps(self, values: Array) -> MotionSteps:
        """Return the steps; see `OdometryModel.steps`."""
        p, (x, y, turn), zero = len(self.names), self.twists.T, np.zeros(len(self.twists))
        path, turn_D = x + 1j * y, np.column_stack((zero, turn, x))[:, :p]
        path_D = np.column_stack((path, zero, zero))[:, :p]
        return MotionSteps(values[0] * path, turn_D[:, 1:] @ values[1:], path_D, turn_D)

    def turn_inputs(self) -> Array:
        """Return the turns, and the forward distances if there is a turn per metre."""
        return self.twists[:, [2, 0][: len(self.names) - 1]]

    def parameters(self, turning: Array, scale: float) -> Array:
        """Return the distance scale and the factors of turning."""
        return np.array([scale, *turning])

    def wheel_turns(self) -> tuple[Array, Array]:
        """Return zeros: the wheels are unknown."""
        zero = np.zeros(len(self.twists))
        return zero, zero


def is_calibrated(odometry: Odometry) -> bool:
    """Return whether `make_model` supports this kind of odometry."""
    return isinstance(odometry, Encoders | OdometryPoses | Velocities)


def make_model(odometry: Odometry, readings: Columns) -> OdometryModel:
    """Return the model of an odometry for its readings (at least two) on one time line.

    A reading older than an earlier row is left out: a pose that a log repeats with the scan it belongs to
    would count at the time of the newest reading, too late. The next reading contains its motion.

    Raises
    ------
    ConfigError
        If this kind of odometry is not calibrated.
    """
    usable = odometry.usable(readings)
    if not odometry.holds:
        readings = readings.take(usable)
    newest = np.maximum.accumulate(readings.stamps)
    readings = readings.take(np.flatnonzero(readings.stamps >= newest))
    stamps, motions = readings.stamps, odometry.motions(readings)
    unknown = np.isnan(motions.d_pose[:, 0])
    if isinstance(odometry, Encoders):
        left, right = odometry.turns(readings)
        return DifferentialDrive(
            stamps, unknown, np.where(unknown, 0.0, left), np.where(unknown, 0.0, right)
        )
    if isinstance(odometry, OdometryPoses):
        names: tuple[str, ...] = ("distance_scale", "turn_scale", "turn_per_metre")
        twists = log(between(readings["pose"][:-1], readings["pose"][1:]))
    elif isinstance(odometry, Velocities):
        names, seconds = ("speed_scale", "turn_scale"), np.diff(stamps)
        speed, rate = readings["speed"][:-1], readings["turn_rate"][:-1]
        twists = np.column_stack((speed * seconds, 0.0 * seconds, rate * seconds))
        stamps = stamps + odometry.latency
    else:
        raise ConfigError(
            f"odometry.kind = {odometry.name!r}: cannot be calibrated; choose encoders, odometry_pose "
            "or velocity with --set odometry.kind="
        )
    return ScaledTwists(names, stamps, unknown, np.where(unknown[:, None], 0.0, twists))


class Motion(NamedTuple):
    """Motions of base_link between pairs of times, for given parameters and latency.

    Attributes
    ----------
    translation : (k,) complex, m, in the frame at the begin
    turn : (k,) rad, not wrapped
    translation_D, turn_D : (k, p + 1) by the parameters, and by the latency
    """

    translation: Complex
    turn: Array
    translation_D: Complex
    turn_D: Array


def motion(
    model: OdometryModel, values: Array, latency: float, begins: Array, ends: Array
) -> Motion:
    """Return the motions between times (k,) and (k,), s, on a clock that is late by the latency, s."""
    headings, positions = _summed(model.steps(values))
    a, b = begins - latency, ends - latency
    h_a, h_b = _at(model.stamps, headings, a), _at(model.stamps, headings, b)
    X_a, X_b = _at(model.stamps, positions, a), _at(model.stamps, positions, b)
    back = np.exp(-1j * h_a[:, 0])
    translation = back * (X_b[:, 0] - X_a[:, 0])
    translation_D = (
        back[:, None] * (X_b[:, 1:] - X_a[:, 1:]) - 1j * translation[:, None] * h_a[:, 1:]
    )
    turns = h_b - h_a
    return Motion(translation, turns[:, 0], translation_D, turns[:, 1:])


def _summed(steps: MotionSteps) -> tuple[Array, Complex]:
    """Return headings and positions (m + 1, 1 + p) at the readings, followed by their derivatives."""
    zero = np.zeros((1, 1 + steps.turn_D.shape[1]))
    turned = np.cumsum(np.column_stack((steps.turn, steps.turn_D)), axis=0)
    headings = np.vstack((zero, turned))
    half = 0.5 * steps.turn
    sinc, sinc_D = np.sinc(half / np.pi), _sinc_D(half)
    direction = np.exp(1j * (headings[:-1, 0] + half))
    chord = direction * steps.path * sinc
    by_turn = direction * steps.path * (0.5j * sinc + 0.5 * sinc_D)
    chord_D = (
        (direction * sinc)[:, None] * steps.path_D
        + by_turn[:, None] * steps.turn_D
        + 1j * chord[:, None] * headings[:-1, 1:]
    )
    return headings, np.vstack((zero, np.cumsum(np.column_stack((chord, chord_D)), axis=0)))


def _sinc_D(x: Array) -> Array:
    """Return the derivative of sin(x)/x."""
    small = np.abs(x) < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, -x / 3.0, (np.cos(safe) - np.sin(safe) / safe) / safe)


def _at(stamps: Array, table: npt.NDArray[Any], times: Array) -> npt.NDArray[Any]:
    """Return rows (k, c + 1) of a table (n, c) at times (k,), with the slope of its first column appended.

    The slope is by the latency, averaged over `WINDOW`: between single readings the noise exceeds the
    motion and would look like information on the latency.
    """
    slope = _rows(stamps, table[:, :1], times + WINDOW) - _rows(
        stamps, table[:, :1], times - WINDOW
    )
    return np.column_stack((_rows(stamps, table, times), -0.5 / WINDOW * slope))


def _rows(stamps: Array, table: npt.NDArray[Any], times: Array) -> npt.NDArray[Any]:
    """Return rows (k, c) of a table (n, c) at times (k,), linear in between."""
    i = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(stamps) - 2)
    seconds = stamps[i + 1] - stamps[i]
    rate = np.divide(1.0, seconds, out=np.zeros_like(seconds), where=seconds > 0.0)
    share = np.clip((times - stamps[i]) * rate, 0.0, 1.0)
    rows: npt.NDArray[Any] = table[i] + (table[i + 1] - table[i]) * share[:, None]
    return rows


def covered(model: OdometryModel, begins: Array, ends: Array) -> Mask:
    """Return (k,) whether readings cover each time span without unknown steps."""
    gaps = np.concatenate(([0], np.cumsum(model.unknown)))
    first = np.searchsorted(model.stamps, begins, side="right") - 1
    last = np.searchsorted(model.stamps, ends, side="left")
    inside = (first >= 0) & (last < len(model.stamps))
    first, last = np.clip(first, 0, len(gaps) - 1), np.clip(last, 0, len(gaps) - 1)
    covers: Mask = inside & (gaps[last] == gaps[first])
    return covers


def sum_between(model: OdometryModel, steps: Array, begins: Array, ends: Array) -> Array:
    """Return the sums (k, c) of quantities (m, c) of the steps, between times (k,) and (k,)."""
    total = np.vstack((np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)))
    return np.asarray(_rows(model.stamps, total, ends) - _rows(model.stamps, total, begins))
