"""Dead reckoning as a function of what is calibrated, with its derivatives, over a whole log at once.

A reading adds a step: a way w (complex, along x + i along y) driven at a constant rate while the robot
turns by a, so that its chord is w exp(i a/2) sin(a/2)/(a/2) (SE(2), as in `odometry`). With headings
h and places X summed up over all steps, the motion between two times is z = exp(-i h_a) (X_b - X_a) and
turns by h_b - h_a; the derivatives of X by the parameters are sums of the same kind.
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
"""s on either side of a time over which speeds are taken."""


class Steps(NamedTuple):
    """m steps and their derivatives by p parameters.

    Attributes
    ----------
    way : (m,) complex, m forward and to the left
    turn : (m,) rad
    way_D, turn_D : (m, p)
    """

    way: Complex
    turn: Array
    way_D: Complex
    turn_D: Array


class OdometryModel(Protocol):
    """Readings of one log and what they mean by some parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """The p parameters, keys of the config's table `odometry`."""

    @property
    def stamps(self) -> Array:
        """(m + 1,) s, not falling."""

    @property
    def unknown(self) -> Mask:
        """(m,) steps of which nothing is known."""

    def steps(self, values: Array) -> Steps:
        """Return the steps by parameters (p,)."""

    def turned(self) -> Array:
        """Return (m, 1 or 2) what the turn of each step is a linear function of."""

    def solved(self, turning: Array, scale: float) -> Array:
        """Return parameters (p,) by the factors (2,) of `turned`, for ways of unit scale times `scale`."""

    def travels(self) -> tuple[Array, Array]:
        """Return (m,) the readings of the left and the right wheel, per step; zeros without wheels."""


@dataclass(frozen=True, eq=False)
class DifferentialDrive:
    """Two wheels with encoders: turned by l and r rad, they drive way (R l + q R r) / 2.

    They turn the robot by (q R r - R l) / b; R is the left wheel's radius, q R the right one's, b the
    track.
    """

    names: ClassVar[tuple[str, ...]] = ("wheel_radius", "right_left_ratio", "track")
    stamps: Array
    unknown: Mask
    left: Array
    right: Array

    def steps(self, values: Array) -> Steps:
        """Return the steps; see `OdometryModel.steps`."""
        radius, ratio, track = values
        left, right, zero = self.left, ratio * self.right, np.zeros_like(self.left)
        way, turn = 0.5 * radius * (left + right), radius * (right - left) / track
        way_D = (0.5 * (left + right), 0.5 * radius * self.right, zero)
        turn_D = ((right - left) / track, radius * self.right / track, -turn / track)
        return Steps(way + 0j, turn, np.column_stack(way_D) + 0j, np.column_stack(turn_D))

    def turned(self) -> Array:
        """Return the turns of both wheels."""
        return np.column_stack((self.left, self.right))

    def solved(self, turning: Array, scale: float) -> Array:
        """Return radius, ratio and track; the track is the scale."""
        return np.array([-turning[0] * scale, -turning[1] / turning[0], scale])

    def travels(self) -> tuple[Array, Array]:
        """Return the turns of both wheels."""
        return self.left, self.right


@dataclass(frozen=True, eq=False)
class ScaledTwists:
    """Odometry that gives motions: twists (m, 3), each over its step.

    Ways are true if scaled by the first parameter, turns by the second; the third, where there is one,
    turns the robot by so much per metre, as wheels of unequal size do.
    """

    names: tuple[str, ...]
    stamps: Array
    unknown: Mask
    twists: Array

    def steps(self, values: Array) -> Steps:
        """Return the steps; see `OdometryModel.steps`."""
        p, (x, y, turn), zero = len(self.names), self.twists.T, np.zeros(len(self.twists))
        way, told = x + 1j * y, np.column_stack((zero, turn, x))[:, :p]
        way_D = np.column_stack((way, zero, zero))[:, :p]
        return Steps(values[0] * way, told[:, 1:] @ values[1:], way_D, told)

    def turned(self) -> Array:
        """Return the turns, and the ways if they turn the robot."""
        return self.twists[:, [2, 0][: len(self.names) - 1]]

    def solved(self, turning: Array, scale: float) -> Array:
        """Return the scale of ways and the factors of turning."""
        return np.array([scale, *turning])

    def travels(self) -> tuple[Array, Array]:
        """Return zeros: nothing is known of the wheels."""
        zero = np.zeros(len(self.twists))
        return zero, zero


def is_calibrated(odometry: Odometry) -> bool:
    """Tell whether `model_of` knows this kind of odometry."""
    return isinstance(odometry, Encoders | OdometryPoses | Velocities)


def model_of(odometry: Odometry, readings: Columns) -> OdometryModel:
    """Return the model of an odometry for its readings (at least two) on one time line.

    Raises
    ------
    ConfigError
        If this kind of odometry is not calibrated.
    """
    usable = odometry.usable(readings)
    if not odometry.holds:
        readings = readings.take(usable)
    motions = odometry.motions(readings)
    unknown = np.isnan(motions.d_pose[:, 0])
    stamps = np.maximum.accumulate(readings.stamps)
    if isinstance(odometry, Encoders):
        left, right = odometry.turns(readings)
        return DifferentialDrive(
            stamps, unknown, np.where(unknown, 0.0, left), np.where(unknown, 0.0, right)
        )
    if isinstance(odometry, OdometryPoses):
        names: tuple[str, ...] = ("distance_scale", "turn_scale", "turn_per_metre")
        told = log(between(readings["pose"][:-1], readings["pose"][1:]))
    elif isinstance(odometry, Velocities):
        names, seconds = ("speed_scale", "turn_scale"), np.diff(stamps)
        speed, rate = readings["speed"][:-1], readings["turn_rate"][:-1]
        told = np.column_stack((speed * seconds, 0.0 * seconds, rate * seconds))
        stamps = stamps + odometry.latency
    else:
        raise ConfigError(
            f"odometry.kind = {odometry.name!r}: cannot be calibrated; choose encoders, odometry_pose "
            "or velocity with --set odometry.kind="
        )
    return ScaledTwists(names, stamps, unknown, np.where(unknown[:, None], 0.0, told))


class Motion(NamedTuple):
    """Motions of base_link between pairs of times, by the parameters and a latency.

    Attributes
    ----------
    way : (k,) complex, m, in the frame at the begin
    turn : (k,) rad, not wrapped
    way_D, turn_D : (k, p + 1) by the parameters, and by the latency
    """

    way: Complex
    turn: Array
    way_D: Complex
    turn_D: Array


def motion(
    model: OdometryModel, values: Array, latency: float, begins: Array, ends: Array
) -> Motion:
    """Return the motions from times (k,) to times (k,), s by a clock that is late by a latency, s."""
    headings, places = _summed(model.steps(values))
    a, b = begins - latency, ends - latency
    h_a, h_b = _at(model.stamps, headings, a), _at(model.stamps, headings, b)
    X_a, X_b = _at(model.stamps, places, a), _at(model.stamps, places, b)
    back = np.exp(-1j * h_a[:, 0])
    way = back * (X_b[:, 0] - X_a[:, 0])
    way_D = back[:, None] * (X_b[:, 1:] - X_a[:, 1:]) - 1j * way[:, None] * h_a[:, 1:]
    turns = h_b - h_a
    return Motion(way, turns[:, 0], way_D, turns[:, 1:])


def _summed(steps: Steps) -> tuple[Array, Complex]:
    """Return headings and places (m + 1, 1 + p) at the readings, each with its derivatives after it."""
    zero = np.zeros((1, 1 + steps.turn_D.shape[1]))
    turned = np.cumsum(np.column_stack((steps.turn, steps.turn_D)), axis=0)
    headings = np.vstack((zero, turned))
    half = 0.5 * steps.turn
    bow, bow_D = np.sinc(half / np.pi), _sinc_D(half)
    facing = np.exp(1j * (headings[:-1, 0] + half))
    chord = facing * steps.way * bow
    by_turn = facing * steps.way * (0.5j * bow + 0.5 * bow_D)
    chord_D = (
        (facing * bow)[:, None] * steps.way_D
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
    """Return rows (k, c + 1) of a table (n, c) at times (k,), and last its slope against a latency.

    That is the mean over `WINDOW`: of one reading to the next the noise is more than the motion, and
    would pass for knowledge of the latency.
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
    """Return (k,) whether readings cover each span of time, and nothing in it is unknown."""
    gaps = np.concatenate(([0], np.cumsum(model.unknown)))
    first = np.searchsorted(model.stamps, begins, side="right") - 1
    last = np.searchsorted(model.stamps, ends, side="left")
    inside = (first >= 0) & (last < len(model.stamps))
    first, last = np.clip(first, 0, len(gaps) - 1), np.clip(last, 0, len(gaps) - 1)
    covers: Mask = inside & (gaps[last] == gaps[first])
    return covers


def sums(model: OdometryModel, steps: Array, begins: Array, ends: Array) -> Array:
    """Return (k, c) the sums of what (m, c) belongs to the steps, between times (k,)."""
    total = np.vstack((np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)))
    return np.asarray(_rows(model.stamps, total, ends) - _rows(model.stamps, total, begins))
