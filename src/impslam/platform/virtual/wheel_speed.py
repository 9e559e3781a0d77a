"""The firmware's speed control of the driven wheels, as proposed in the thesis for its autopilot (3.3.1).

The motor is modelled as y' = (u - y) / T, with u the no-load speed at its voltage. A reference r follows
the command with the time constant L, limited by motor and supply:

    r' = (command - r) / L,      u = r + T r'  (feed-forward: the motor inverted)
                                   + K (e + integral of e / T_i - T_d y'),   e = r - y.

Gains follow from the model by SIMC (Skogestad, J. Process Control 13, 2003): K = T / (F + D),
T_i = min(T, 4 (F + D)), with F the time in which the loop compensates a load and D the dead time of
measuring and holding; T_d is the motor's second time constant, that of its inductance, and negligible
here. While u is at its limit, the excess is fed back to the integral with the time constant T_i (Astrom
and Hagglund, Advanced PID Control, 2006, 3.5), and the integral is limited to the greatest load.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.types import Array


class SpeedControl(Parameters):
    """Settings of the controller: motors and wheels."""

    time_constant: float = parameter(0.1, "s", "of the motor with the robot's mass", gt=0.0)
    second: float = parameter(0.0, "s", "of the motor's inductance: some 1 ms", ge=0.0)
    closed: float = parameter(
        0.05, "s", "time constant of the reference: half the motor's, at twice its voltage", gt=0.0
    )
    feedback: float = parameter(
        0.2,
        "s",
        "time in which a load is compensated: twice the motor's. Uneven ground (1 cm after 1 m) is 50 mm/s "
        "in a mean over 10 ms; the motors then follow it by less than 1 % of their top speed",
        gt=0.0,
    )
    most_load: float = parameter(
        0.3, "1", "share of the top speed that a load may take; more is a stall", gt=0.0, le=1.0
    )
    period: float = parameter(0.01, "s", "between two steps; speeds are means over it", gt=0.0)
    top_speed: float = parameter(1.0, "m/s", "no-load speed at full voltage", gt=0.0)
    acceleration: float = parameter(5.0, "m/s^2", "maximum of the motors", gt=0.0)
    skid: float = parameter(
        1.5625,
        "1",
        "how much more the driven sides differ than the passive wheels on the same track: as `skid` of the "
        "host's driver",
        ge=1.0,
    )
    count: float = parameter(
        2.0 * math.pi * 0.0635 / 4096, "m", "travel of a passive wheel per count", gt=0.0
    )

    @property
    def dead_time(self) -> float:
        """Half a period of the mean plus half a period until the next step, s."""
        return self.period

    @property
    def gain(self) -> float:
        """Return K, (m/s) / (m/s)."""
        return self.time_constant / (self.feedback + self.dead_time)

    @property
    def integral_time(self) -> float:
        """Return T_i, s."""
        return min(self.time_constant, 4.0 * (self.feedback + self.dead_time))


class SpeedController:
    """The controller of both sides, left first.

    Parameters
    ----------
    settings : motors and wheels
    anti_windup : without it, the integral grows while the motors are at their limit (for comparison)
    """

    def __init__(self, settings: SpeedControl | None = None, *, anti_windup: bool = True) -> None:
        self.settings = settings or SpeedControl()
        self._anti_windup = anti_windup
        self.reset()

    def reset(self) -> None:
        """Reset the state: the motors are off."""
        self.commanded = np.zeros(2)
        self._reference, self._mean = np.zeros(2), np.zeros(2)
        self._integral = np.zeros(2)
        self._counts: Array | None = None
        self._before: Array | None = None

    def step(self, counts: tuple[int, int]) -> Array:
        """Return the commands (2,) of the motor drivers, m/s, from the accumulators, once a period."""
        s = self.settings
        measured = self._measured(np.array(counts, np.float64))
        error = self._mean - measured  # both are means over the last period
        slope = np.zeros(2) if self._before is None else (measured - self._before) / s.period
        self._before = measured
        ahead = self._advance()
        feedback = s.gain * (error + self._integral / s.integral_time - s.second * slope)
        wanted = ahead + feedback
        output = np.clip(wanted, -s.top_speed, s.top_speed)
        self._integral += error * s.period
        if self._anti_windup:
            self._integral += (output - wanted) * s.period / s.gain
            limit = s.most_load * s.top_speed * s.integral_time / s.gain
            self._integral = np.clip(self._integral, -limit, limit)
        return output

    def _measured(self, counts: Array) -> Array:
        """Return the speeds (2,) of the driven sides, as measured by the passive wheels, m/s."""
        s = self.settings
        if self._counts is None:
            self._counts = counts
        passive = (counts - self._counts) * s.count / s.period
        self._counts = counts
        middle, half = passive.mean(), 0.5 * s.skid * (passive[1] - passive[0])
        return np.array([middle - half, middle + half])

    def _advance(self) -> Array:
        """Advance the reference by a period; return the feed-forward command (2,), m/s."""
        s = self.settings
        share = -math.expm1(-s.period / s.closed)
        rate = share * (self.commanded - self._reference) / s.period
        room = (s.top_speed * np.sign(rate) - self._reference) / s.time_constant
        limit = np.minimum(s.acceleration, np.abs(room))
        rate = np.clip(rate, -limit, limit)
        start = self._reference
        self._reference = start + rate * s.period
        self._mean = 0.5 * (start + self._reference)
        return np.asarray(self._mean + s.time_constant * rate)
