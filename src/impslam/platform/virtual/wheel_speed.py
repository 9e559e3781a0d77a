"""The firmware's control of the driven wheels' speed: what the thesis proposes for its autopilot (3.3.1).

The motor is taken as y' = (u - y) / T with u the speed that its voltage gives without load. A reference r
follows the command with the time constant L, and at most as fast as motor and supply allow:

    r' = (command - r) / L,      u = r + T r'  (feed-forward: the motor inverted)
                                   + K (e + integral of e / T_i - T_d y'),   e = r - y.

Gains follow from the model by SIMC (Skogestad, J. Process Control 13, 2003): K = T / (F + D),
T_i = min(T, 4 (F + D)), with F the time in which the loop is to make up for a load and D the dead time of
measuring and holding; T_d is the motor's second time constant, which belongs to its inductance and is
negligible here. While u is at its limit, what was cut off is fed back to the integral with the time
constant T_i (Astrom and Hagglund, Advanced PID Control, 2006, 3.5), and the integral makes up for no more
than the greatest load.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.types import Array


class SpeedControl(Parameters):
    """What the controller knows of motors and wheels."""

    time_constant: float = parameter(0.1, "s", "of the motor with the robot's mass", gt=0.0)
    second: float = parameter(0.0, "s", "of the motor's inductance: some 1 ms", ge=0.0)
    closed: float = parameter(
        0.05, "s", "time constant of the reference: half the motor's, at twice its voltage", gt=0.0
    )
    feedback: float = parameter(
        0.2,
        "s",
        "in which a load is made up for: twice the motor's. Uneven ground (1 cm after 1 m) is 50 mm/s in "
        "a mean over 10 ms; the motors then follow it by less than 1 % of their top speed",
        gt=0.0,
    )
    most_load: float = parameter(
        0.3, "1", "share of the top speed that a load may take; more is a stall", gt=0.0, le=1.0
    )
    period: float = parameter(0.01, "s", "between two steps; speeds are means over it", gt=0.0)
    top_speed: float = parameter(1.0, "m/s", "that the full voltage gives without load", gt=0.0)
    acceleration: float = parameter(5.0, "m/s^2", "that the motors can give", gt=0.0)
    skid: float = parameter(
        1.5625,
        "1",
        "how much more the driven sides differ than the passive wheels on the same track: as `skid` of the "
        "host's driver",
        ge=1.0,
    )
    count: float = parameter(
        2.0 * math.pi * 0.0635 / 4096, "m", "way of a passive wheel in one count", gt=0.0
    )

    @property
    def dead_time(self) -> float:
        """Half a period of the mean, half a period until the next step, in s."""
        return self.period

    @property
    def gain(self) -> float:
        """Return K, (m/s) / (m/s)."""
        return self.time_constant / (self.feedback + self.dead_time)

    @property
    def integral_time(self) -> float:
        """Return T_i in s."""
        return min(self.time_constant, 4.0 * (self.feedback + self.dead_time))


class SpeedController:
    """The controller of both sides, left first.

    Parameters
    ----------
    settings : what it knows
    anti_windup : without it the integral grows while the motors give all they can (for comparison)
    """

    def __init__(self, settings: SpeedControl | None = None, *, anti_windup: bool = True) -> None:
        self.settings = settings or SpeedControl()
        self._anti_windup = anti_windup
        self.reset()

    def reset(self) -> None:
        """Forget everything: the motors are off."""
        self.asked = np.zeros(2)
        self._reference, self._mean = np.zeros(2), np.zeros(2)
        self._integral = np.zeros(2)
        self._counts: Array | None = None
        self._before: Array | None = None

    def step(self, counts: tuple[int, int]) -> Array:
        """Return (2,) m/s to tell the motor drivers, from the accumulators, once a period."""
        s = self.settings
        measured = self._measured(np.array(counts, np.float64))
        error = self._mean - measured  # both are means over the last period
        slope = np.zeros(2) if self._before is None else (measured - self._before) / s.period
        self._before = measured
        ahead = self._advance()
        feedback = s.gain * (error + self._integral / s.integral_time - s.second * slope)
        wanted = ahead + feedback
        given = np.clip(wanted, -s.top_speed, s.top_speed)
        self._integral += error * s.period
        if self._anti_windup:
            self._integral += (given - wanted) * s.period / s.gain
            most = s.most_load * s.top_speed * s.integral_time / s.gain
            self._integral = np.clip(self._integral, -most, most)
        return given

    def _measured(self, counts: Array) -> Array:
        """Return the speeds of the driven sides (2,) m/s that the passive wheels tell."""
        s = self.settings
        if self._counts is None:
            self._counts = counts
        passive = (counts - self._counts) * s.count / s.period
        self._counts = counts
        middle, half = passive.mean(), 0.5 * s.skid * (passive[1] - passive[0])
        return np.array([middle - half, middle + half])

    def _advance(self) -> Array:
        """Move the reference on by a period; return what keeps an ideal motor on it (2,) m/s."""
        s = self.settings
        share = -math.expm1(-s.period / s.closed)
        rate = share * (self.asked - self._reference) / s.period
        room = (s.top_speed * np.sign(rate) - self._reference) / s.time_constant
        most = np.minimum(s.acceleration, np.abs(room))
        rate = np.clip(rate, -most, most)
        start = self._reference
        self._reference = start + rate * s.period
        self._mean = 0.5 * (start + self._reference)
        return np.asarray(self._mean + s.time_constant * rate)
