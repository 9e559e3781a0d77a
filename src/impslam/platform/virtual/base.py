"""What an emulator is: a device without its port. Bytes in, bytes out, at given times.

Emulators know no port and no clock of their own, so that the same code runs in real time behind a
pseudo-terminal and as fast as possible in a test. All times are in s since the virtual robot began.
"""

from __future__ import annotations

from typing import Protocol

from impslam.types import Array


class Emulator(Protocol):
    """A device as its port sees it."""

    def receive(self, data: bytes, time: float) -> None:
        """Take what the host sent; any bytes, cut anywhere."""

    def due(self, time: float) -> bytes:
        """Return what the device sends between the last call and `time`; called about every ms."""

    def reboot(self, time: float) -> None:
        """Forget everything, as when the supply fails for a moment; its clock begins anew."""


class Vehicle(Protocol):
    """The body, as the autopilot's wires see it."""

    def drive(self, left: float, right: float) -> None:
        """Set what the motor drivers are told: surface speeds of both driven wheels a side, m/s."""

    def wheel_angles(self) -> tuple[float, float]:
        """Return how far the two passive wheels have turned, in rad, accumulated, left first."""

    def inertial(self) -> tuple[Array, Array]:
        """Return angular velocity (3,) rad/s and specific force (3,) m/s^2 at base_link."""

    def heading(self) -> float:
        """Return the true heading in rad, which the magnetometer feels."""


class Surroundings(Protocol):
    """The world, as the lidar's beams see it."""

    def ranges(self, time: float) -> Array:
        """Return what the beams (n,) of the sweep that began at `time` read, in m; 0: no echo.

        The sweep must have ended by now.
        """
