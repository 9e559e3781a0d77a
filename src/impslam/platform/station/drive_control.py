"""Drive control: one driver at a time, a timeout of commands, and the emergency stop.

A command is valid for `COMMAND_TIMEOUT`; after that, drive control commands zero speed. The
micro-controller stops by itself 0.2 s later if even that does not reach it. Anyone can trigger the
emergency stop; it overrides all commands until the driver releases it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from impslam.errors import ImpError
from impslam.platform.devices.base import DriveDevice, now

log = logging.getLogger(__name__)

COMMAND_TIMEOUT = 0.3  # s; a page sends ten commands a second, so two may be lost
HANG_TIMEOUT = 5.0  # s without a command sent: drive control hangs; twice a port's longest write
PERIOD = 0.05  # s between commands to the device: six within COMMAND_TIMEOUT


class DriveControlError(ImpError):
    """A refused command; the message says what to do."""


@dataclass(frozen=True, slots=True)
class DriveControlState:
    """The public state of drive control.

    Attributes
    ----------
    driver : id of the driver, None if nobody drives
    name : the driver's name on the page, "" if nobody drives
    stopped : why the emergency stop is active, "" if it is not
    speed, turn_rate : m/s and rad/s, the present command to the device
    blockage : why the robot does not move as it is driven, "" if it does
    """

    driver: str | None
    name: str
    stopped: str
    speed: float
    turn_rate: float
    blockage: str = ""


class DriveControl:
    """Forwards the commands of one driver to the drive device, as long as they keep coming.

    Parameters
    ----------
    device : the drive device, None if the robot has none
    limits : m/s and rad/s; commands are clipped to them
    notify : called with (level, text) for events that everyone should see
    on_command : called with (m/s, rad/s) for each command to move and for the first zero command
    """

    def __init__(
        self,
        device: DriveDevice | None,
        limits: tuple[float, float],
        notify: Callable[[str, str], None] = lambda level, text: None,
        on_command: Callable[[float, float], None] = lambda speed, turn_rate: None,
    ) -> None:
        self._device, self._limits = device, limits
        self._notify, self._on_command = notify, on_command
        self._lock = threading.Lock()
        self._driver: tuple[str, str] | None = None
        self._stopped = ""
        self._command, self._commanded_at = (0.0, 0.0), float("-inf")
        self._sent_command = (0.0, 0.0)
        self._sent_at = now()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="drive_control", daemon=True)

    def start(self) -> None:
        """Start to send commands to the device."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the robot and end the thread."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def take(self, driver: str, name: str) -> None:
        """Become the driver; the robot stops if the same person drove from another page.

        Raises
        ------
        DriveControlError
            If someone else drives.
        """
        with self._lock:
            if self._device is None:
                raise DriveControlError(
                    "this robot has no drive; add a drive device to the robot file"
                )
            if self._driver is not None and driver != self._driver[0] and name != self._driver[1]:
                raise DriveControlError(
                    f"{self._driver[1]} is driving; ask them to release control"
                )
            changed = self._driver is None
            if self._driver != (driver, name):
                self._driver, self._command = (driver, name), (0.0, 0.0)
        if changed:
            self._notify("info", f"{name} takes control")

    def leave(self, driver: str) -> None:
        """Release control; the robot stops. Does nothing for anyone but the driver."""
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                return
            name = self._driver[1]
            self._driver, self._command = None, (0.0, 0.0)
        self._notify("info", f"{name} releases control")

    def drive(self, driver: str, speed: float, turn_rate: float, age: float = 0.0) -> None:
        """Command a forward speed and a turn rate; repeat it within `COMMAND_TIMEOUT`.

        During an emergency stop, commands are accepted and have no effect.

        Parameters
        ----------
        driver : id of who commands
        speed, turn_rate : m/s and rad/s
        age : s since the command was given; one of `COMMAND_TIMEOUT` or older is dropped

        Raises
        ------
        DriveControlError
            If it is not from the driver, or not finite; the previous command then stays valid.
        """
        if not (abs(speed) < float("inf") and abs(turn_rate) < float("inf")):
            raise DriveControlError(f"a command of {speed} m/s and {turn_rate} rad/s is not finite")
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                raise DriveControlError("take control before you drive")
            if age >= COMMAND_TIMEOUT:
                return
            self._command = _clipped(speed, self._limits[0]), _clipped(turn_rate, self._limits[1])
            self._commanded_at = now() - age
        self._send()

    def emergency_stop(self, by: str) -> None:
        """Stop the robot at once, for anyone, until `release`."""
        with self._lock:
            changed = not self._stopped
            self._stopped = f"emergency stop by {by}"
            self._command = (0.0, 0.0)
            # Within the lock, so that the device and this agree if a release comes at the same time.
            if self._device is not None:
                self._device.emergency_stop()
        if changed:
            self._notify("warning", f"emergency stop by {by}")

    def release(self, driver: str) -> None:
        """End the emergency stop; the robot does not move until the next command.

        Raises
        ------
        DriveControlError
            If it is not from the driver.
        """
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                raise DriveControlError("take control before you release the emergency stop")
            changed = bool(self._stop_reason())
            self._stopped, self._command = "", (0.0, 0.0)
            name = self._driver[1]
            if self._device is not None:
                self._device.release()
        if changed:
            self._notify("info", f"emergency stop released by {name}")

    def state(self) -> DriveControlState:
        """Return who drives and the present command."""
        with self._lock:
            driver, name = self._driver or (None, "")
            blockage = "" if self._device is None else self._device.blockage
            command = self._current_command()
            return DriveControlState(driver, name, self._stop_reason(), *command, blockage)

    def _stop_reason(self) -> str:
        """Return why the robot is stopped; the device may hold a stop from before this program ran."""
        if self._stopped or self._device is None or not self._device.stopped:
            return self._stopped
        return f"emergency stop held by {self._device.title}"

    def _current_command(self) -> tuple[float, float]:
        fresh = now() - self._commanded_at < COMMAND_TIMEOUT
        return self._command if fresh and not self._stopped else (0.0, 0.0)

    @property
    def alive(self) -> bool:
        """Whether commands are still sent."""
        return self._thread.is_alive() and now() - self._sent_at < HANG_TIMEOUT

    def _run(self) -> None:
        while not self._closing.wait(PERIOD):
            try:
                self._send()
            except Exception:  # a bug; if it persists, the watchdog notices
                log.exception("drive control")
            else:
                self._sent_at = now()
        if self._device is not None:
            self._device.drive(0.0, 0.0)

    def _send(self) -> None:
        """Send the present command; zeros are repeated as well, since a frame may be lost."""
        with self._lock:
            device = self._device
            speed, turn_rate = self._current_command()
            stopped = self._stopped
            if device is None or stopped:
                return
            # Within the lock, so that no thread sends an old command after a newer one.
            device.drive(speed, turn_rate)
            changed = (speed, turn_rate) != self._sent_command or (speed, turn_rate) != (0.0, 0.0)
            self._sent_command = (speed, turn_rate)
        if changed:
            self._on_command(speed, turn_rate)


def _clipped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
