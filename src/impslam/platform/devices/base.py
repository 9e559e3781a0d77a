"""The base class of devices: a thread that serves one piece of hardware and reopens it after errors.

A device opens its port, serves it until it fails, reports the error, waits, and opens it again. Its
readings, stamped on the host's time base, go to one receiver. No error of the hardware ends the
thread, and every loss is counted.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias

from pydantic import PrivateAttr

from impslam.component import Component, parameter
from impslam.errors import ImpError
from impslam.types import Event, Message

log = logging.getLogger(__name__)

State: TypeAlias = Literal["stopped", "opening", "ok", "silent", "lost"]

_WALL, _MONOTONIC = time.time(), time.monotonic()
RATE_WINDOW = 2.0  # s over which rates are measured: two digits at 100 Hz, and a stop shows at once


def now() -> float:
    """Return the time on the host's time base, s since 1970; never stepped.

    All stamps of a log use it. The wall clock may be set back by the network during a recording, so it
    is only read at the start of the program, and continued by the monotonic clock.
    """
    return _WALL + (time.monotonic() - _MONOTONIC)


class DeviceError(ImpError):
    """A device that cannot be opened or does not answer; the message says what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A message, stamped on the host's time base, and when its last byte `arrived` there.

    `device_stamp` is its stamp by the device's clock, s since the device started (unwrapped), None if
    the device has no clock.
    """

    message: Message
    arrived: float
    device: str
    device_stamp: float | None = None


def event(source: str, level: str, text: str) -> Reading:
    """Log an event ("info", "warning" or "error"), and return it as a reading for the recording."""
    log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", source, text)
    moment = now()
    return Reading(Event(moment, level, source, text), moment, source)


Receiver: TypeAlias = Callable[[Reading], None]


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """The status of a device.

    Attributes
    ----------
    state : "ok"; "silent" (open, but without a message for `timeout`); "lost" (cannot be opened, is
        retried); "opening"; "stopped"
    detail : model and firmware while ok, otherwise the error and what to do
    rates : messages per second by type, over the last `RATE_WINDOW`
    counts : counters since the start: frames, lost, corrupt, repeated, late, reopened, ...
    last : host time of the last message, NaN before the first
    """

    state: State
    detail: str
    rates: dict[str, float]
    counts: dict[str, int]
    last: float


@dataclass(slots=True)
class _Vitals:
    """The data behind `health`, guarded by the lock."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    state: State = "stopped"
    detail: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    recent: dict[str, deque[float]] = field(default_factory=dict)
    last: float = float("nan")
    reasons: set[str] = field(default_factory=set)  # of losses, notified since it was open


class Device(Component):
    """A piece of hardware and the thread that serves it."""

    role: ClassVar[str] = "device"

    label: str = parameter("", "1", "name in messages, logs and on the page; empty: the kind")
    timeout: float = parameter(
        1.0,
        "s",
        "a device without messages for this long is silent: ten frames of the slowest",
        gt=0,
    )
    retry: float = parameter(0.5, "s", "wait before a lost device is opened again", gt=0)

    _vitals: _Vitals = PrivateAttr(default_factory=_Vitals)
    _receiver: Receiver | None = PrivateAttr(default=None)
    _thread: threading.Thread | None = PrivateAttr(default=None)
    _stopping: threading.Event = PrivateAttr(default_factory=threading.Event)

    @abstractmethod
    def _serve(self) -> None:
        """Open the hardware and deliver its messages until `_stopping` is set.

        Call `_ready` once it is open and `_deliver` for each message, and always close it. Waits must
        end within 0.2 s of `_stopping`.

        Raises
        ------
        DeviceError
            If it cannot be opened, or fails; it is opened again after `retry`.
        """

    @property
    def title(self) -> str:
        """Its name in messages, logs and on the page."""
        return self.label or self.name

    def start(self, receiver: Receiver) -> None:
        """Serve the device in its own thread, which calls `receiver` with readings."""
        if self._thread is not None:
            raise RuntimeError(f"{self.title} has been started already")
        self._receiver = receiver
        self._stopping.clear()
        self._thread = threading.Thread(target=self._keep_serving, name=self.title, daemon=True)
        self._thread.start()

    def stop(self, wait: float = 2.0) -> None:
        """End the thread and close the device."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(wait)
            self._thread = None
        self._set_state("stopped", "")

    def health(self) -> DeviceHealth:
        """Return the status of the device."""
        vitals, moment = self._vitals, now()
        with vitals.lock:
            state, last = vitals.state, vitals.last
            if state == "ok" and not moment - last < self.timeout:
                state = "silent"
            rates = {
                kind: sum(stamp > moment - RATE_WINDOW for stamp in stamps) / RATE_WINDOW
                for kind, stamps in vitals.recent.items()
            }
            return DeviceHealth(state, vitals.detail, rates, dict(vitals.counts), last)

    def _keep_serving(self) -> None:
        while not self._stopping.is_set():
            self._set_state("opening", "")
            try:
                self._serve()
            except DeviceError as error:
                self._report_loss(str(error))
            except Exception as error:  # a bug here must not stop the robot
                log.exception("%s", self.title)
                self._report_loss(f"{type(error).__name__}: {error}; please report it")
            self._stopping.wait(self.retry)

    def _report_loss(self, reason: str) -> None:
        """Count a loss, but not the attempts to open the device again; notify once per reason."""
        with self._vitals.lock:
            lost = self._vitals.state == "lost"
            known = reason in self._vitals.reasons  # two reasons may alternate
            self._vitals.reasons.add(reason)
        if not lost:
            self._count("lost connection")
        self._set_state("lost", reason)
        if not known:
            self._notify("error", reason)

    def _set_state(self, state: State, detail: str) -> None:
        with self._vitals.lock:
            if state == "opening" and self._vitals.state == "lost":
                return  # keep the error readable while it is retried
            self._vitals.state, self._vitals.detail = state, detail

    def _ready(self, detail: str) -> None:
        """Report that the device is open, with its description."""
        with self._vitals.lock:
            self._vitals.last = now()
            self._vitals.reasons.clear()
        self._set_state("ok", detail)
        self._notify("info", detail)

    def _notify(self, level: Literal["info", "warning", "error"], text: str) -> None:
        """Log an event and deliver it for the recording."""
        self._send(event(self.title, level, text))

    def _count(self, what: str, number: int = 1) -> None:
        """Increase a counter."""
        with self._vitals.lock:
            self._vitals.counts[what] += number

    def _deliver(self, message: Message, arrived: float, device_stamp: float | None = None) -> None:
        """Count a message and send it to the receiver."""
        vitals, kind = self._vitals, type(message).__name__
        with vitals.lock:
            vitals.counts[kind] += 1
            recent = vitals.recent.setdefault(kind, deque(maxlen=512))
            recent.append(arrived)
            vitals.last = arrived
        self._send(Reading(message, arrived, self.title, device_stamp))

    def _send(self, reading: Reading) -> None:
        """Call the receiver; an error of the receiver must not disturb the device."""
        if self._receiver is None:
            return
        try:
            self._receiver(reading)
        except Exception:
            self._count("not received: error")
            if self._vitals.counts["not received: error"] == 1:  # log only the first one
                log.exception("%s: the receiver of its readings fails", self.title)


class DriveDevice(Device):
    """A device that moves the robot. Commands may be called from any thread and return at once."""

    @property
    def stopped(self) -> bool:
        """Whether it reports an active emergency stop, from any source."""
        return False

    @property
    def blockage(self) -> str:
        """Why the robot does not move as it is driven, in one line; "" if it does, or is not known."""
        return ""

    @abstractmethod
    def drive(self, speed: float, turn_rate: float) -> None:
        """Command a forward speed (m/s) and a turn rate (rad/s); the device stops after a timeout.

        While the device is lost, the command is only counted.
        """

    @abstractmethod
    def emergency_stop(self) -> None:
        """Stop, and ignore drive commands until `release`; sent repeatedly until answered."""

    @abstractmethod
    def release(self) -> None:
        """End an emergency stop."""
