"""The helm: who drives, and what stops the robot when nobody does.

One driver at a time; others watch. A command holds for `DEAD_MAN` and then the robot is told to
stand; the micro-controller stops by itself `0.2 s` later if even that does not reach it. An
emergency stop comes from anyone, wins over everything and stays until the driver releases it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from impslam.errors import ImpError
from impslam.platform.devices.base import DriveDevice, now

log = logging.getLogger(__name__)

DEAD_MAN = 0.3  # s; a page sends ten commands a second, so that two may be lost on the way
ALIVE = 5.0  # s without passing anything on: the helm hangs; twice a port's longest write
PERIOD = 0.05  # s between commands to the device: six reach it before its own dead man of 0.5 s


class HelmError(ImpError):
    """A command that is refused: what, and what to do."""


@dataclass(frozen=True, slots=True)
class HelmState:
    """What everyone may see.

    Attributes
    ----------
    driver : id of who drives, None if nobody does
    name : how that one is called on the page, "" if nobody drives
    stopped : why the emergency stop holds, "" if it does not
    speed, turn_rate : m/s and rad/s, what the device is being told
    """

    driver: str | None
    name: str
    stopped: str
    speed: float
    turn_rate: float


class Helm:
    """Passes commands from one driver to the device that moves the robot, as long as they come.

    Parameters
    ----------
    device : what moves the robot, None where nothing does
    limits : m/s and rad/s that no command may exceed; what is beyond is cut to them
    tell : called with (level, text) for what everyone should know
    sent : called with (m/s, rad/s) when the device is told to move, or anew to stand
    """

    def __init__(
        self,
        device: DriveDevice | None,
        limits: tuple[float, float],
        tell: Callable[[str, str], None] = lambda level, text: None,
        sent: Callable[[float, float], None] = lambda speed, turn_rate: None,
    ) -> None:
        self._device, self._limits, self._tell, self._sent = device, limits, tell, sent
        self._lock = threading.Lock()
        self._driver: tuple[str, str] | None = None
        self._stopped = ""
        self._command, self._given = (0.0, 0.0), float("-inf")
        self._told = (0.0, 0.0)
        self._passed = now()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="helm", daemon=True)

    def start(self) -> None:
        """Begin to pass commands on."""
        self._thread.start()

    def stop(self) -> None:
        """Stand still and end."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def take(self, driver: str, name: str) -> None:
        """Become the driver.

        Raises
        ------
        HelmError
            If someone else drives.
        """
        with self._lock:
            if self._device is None:
                raise HelmError("this robot has nothing to drive with; add a drive device to it")
            if self._driver is not None and self._driver[0] != driver:
                raise HelmError(f"{self._driver[1]} is driving; ask them to let go of the helm")
            news = self._driver is None
            self._driver = (driver, name)
        if news:
            self._tell("info", f"{name} takes the helm")

    def leave(self, driver: str) -> None:
        """Let go of the helm; the robot stands. Does nothing for who does not drive."""
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                return
            name = self._driver[1]
            self._driver, self._command = None, (0.0, 0.0)
        self._tell("info", f"{name} lets go of the helm")

    def drive(self, driver: str, speed: float, turn_rate: float, age: float = 0.0) -> None:
        """Command a speed forward (m/s) and a turn rate (rad/s); repeat it within `DEAD_MAN`.

        Parameters
        ----------
        driver : who commands
        speed, turn_rate : m/s and rad/s
        age : s since the command was given. It holds until `DEAD_MAN` after that; one that is older
            has waited somewhere on its way, and is dropped.

        Raises
        ------
        HelmError
            If it comes from another than the driver, or is no number; the robot then goes on as
            before. During an emergency stop commands are accepted and have no effect.
        """
        if not (abs(speed) < float("inf") and abs(turn_rate) < float("inf")):
            raise HelmError(f"a command of {speed} m/s and {turn_rate} rad/s is no motion")
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                raise HelmError("take the helm before you drive")
            if age >= DEAD_MAN:
                return
            self._command = _within(speed, self._limits[0]), _within(turn_rate, self._limits[1])
            self._given = now() - age
        self._pass_on()

    def emergency_stop(self, by: str) -> None:
        """Stop, from anyone, at once; it holds until `release`."""
        with self._lock:
            news = not self._stopped
            self._stopped = f"emergency stop by {by}"
            self._command = (0.0, 0.0)
            # Within the lock, so that device and helm agree when a release comes at the same time.
            if self._device is not None:
                self._device.emergency_stop()
        if news:
            self._tell("warning", f"emergency stop by {by}")

    def release(self, driver: str) -> None:
        """End the emergency stop; only the driver may, and the robot stands until commanded anew.

        Raises
        ------
        HelmError
            If it comes from another than the driver.
        """
        with self._lock:
            if self._driver is None or self._driver[0] != driver:
                raise HelmError("take the helm before you release the emergency stop")
            news = bool(self._held())
            self._stopped, self._command = "", (0.0, 0.0)
            name = self._driver[1]
            if self._device is not None:
                self._device.release()
        if news:
            self._tell("info", f"emergency stop released by {name}")

    def state(self) -> HelmState:
        """Return who drives and what the device is being told."""
        with self._lock:
            driver, name = self._driver or (None, "")
            return HelmState(driver, name, self._held(), *self._wanted())

    def _held(self) -> str:
        """Return why the robot is stopped: here, or by what it was told before this program ran."""
        if self._stopped or self._device is None or not self._device.stopped:
            return self._stopped
        return f"emergency stop held by {self._device.title}"

    def _wanted(self) -> tuple[float, float]:
        fresh = now() - self._given < DEAD_MAN
        return self._command if fresh and not self._stopped else (0.0, 0.0)

    @property
    def alive(self) -> bool:
        """Whether commands are still passed on."""
        return self._thread.is_alive() and now() - self._passed < ALIVE

    def _keep(self) -> None:
        while not self._closing.wait(PERIOD):
            try:
                self._pass_on()
            except Exception:  # a fault of ours; the watchdog sees it where it lasts
                log.exception("helm")
            else:
                self._passed = now()
        if self._device is not None:
            self._device.drive(0.0, 0.0)

    def _pass_on(self) -> None:
        """Tell the device what is wanted; a stand is repeated as well, since a frame may be lost."""
        with self._lock:
            device, (speed, turn_rate), stopped = self._device, self._wanted(), self._stopped
            if device is None or stopped:
                return
            # Within the lock, so that no thread sends an older command after a newer one.
            device.drive(speed, turn_rate)
            news = (speed, turn_rate) != self._told or (speed, turn_rate) != (0.0, 0.0)
            self._told = (speed, turn_rate)
        if news:
            self._sent(speed, turn_rate)


def _within(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
