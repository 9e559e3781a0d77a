"""Protocols of emulators: devices without a port, with bytes in and bytes out at given times.

Emulators have no port and no clock of their own, so that the same code runs in real time behind a
pseudo-terminal and as fast as possible in a test. All times are in s since the start of the virtual
robot.
"""

from __future__ import annotations

from typing import Protocol

from impslam.types import Array


class Emulator(Protocol):
    """A device as seen from its port."""

    def receive(self, data: bytes, time: float) -> None:
        """Process bytes from the host, in pieces of any size."""

    def due(self, time: float) -> bytes:
        """Return the bytes sent between the last call and `time`; called about every ms."""

    def reboot(self, time: float) -> None:
        """Reset everything, with the clock, as after a short power failure."""


class Vehicle(Protocol):
    """The body as seen from the autopilot."""

    def drive(self, left: float, right: float) -> None:
        """Command the motor drivers: surface speeds of the driven wheels of each side, m/s."""

    def wheel_angles(self) -> tuple[float, float]:
        """Return the accumulated angles of the two passive wheels, rad, left first."""

    def inertial(self) -> tuple[Array, Array]:
        """Return angular velocity (3,) rad/s and specific force (3,) m/s^2 at base_link."""

    def heading(self) -> float:
        """Return the true heading, rad, for the magnetometer."""


class Surroundings(Protocol):
    """The world as seen from the lidar."""

    def ranges(self, time: float) -> Array:
        """Return the ranges (n,) of the sweep that began at `time`, m; 0: no echo.

        The sweep must have ended by now.
        """
