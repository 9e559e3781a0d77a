"""The role of a device: a thread that keeps one piece of hardware talking, whatever happens to it.

A device opens its port, serves it until it fails, tells why, waits, and opens it again. What it
reads goes, stamped on the host's time base, to one receiver. Nothing that happens on the wire ends
the thread; nothing is lost without being counted.
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
RATE_SPAN = 2.0  # s over which rates are told: two digits at 100 Hz, and a stop is seen at once


def now() -> float:
    """Return the host's time base: s since 1970 as of the program's start, never stepped.

    All stamps of a log are on it. A clock that the network sets would run backwards in the middle
    of a recording; this one takes the wall clock once and counts on from there.
    """
    return _WALL + (time.monotonic() - _MONOTONIC)


class DeviceError(ImpError):
    """A device that cannot be opened or has stopped to answer: what, where, what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A message, stamped on the host's time base, and when its last byte `arrived` there.

    `device_stamp` is the device's own clock for it, in s since the device started (unwrapped),
    None where the device has no clock.
    """

    message: Message
    arrived: float
    device: str
    device_stamp: float | None = None


def event(source: str, level: str, text: str) -> Reading:
    """Log what happened ("info", "warning" or "error"), and return it for the recording."""
    log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", source, text)
    moment = now()
    return Reading(Event(moment, level, source, text), moment, source)


Receiver: TypeAlias = Callable[[Reading], None]


@dataclass(frozen=True, slots=True)
class Health:
    """How a device is doing.

    Attributes
    ----------
    state : "ok"; "silent" (open, but nothing came for `patience`); "lost" (cannot be opened, being
        tried again); "opening"; "stopped"
    detail : what it is (model, firmware) while ok, what is wrong and what to do otherwise
    rates : messages per second by type, over the last `RATE_SPAN`
    counts : everything counted since the start: frames, lost, corrupt, repeated, late, reopened, ...
    last : host time of the last message, NaN before the first
    """

    state: State
    detail: str
    rates: dict[str, float]
    counts: dict[str, int]
    last: float


@dataclass(slots=True)
class _Vitals:
    """What `health` is made from; guarded by the lock."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    state: State = "stopped"
    detail: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    recent: dict[str, deque[float]] = field(default_factory=dict)
    last: float = float("nan")


class Device(Component):
    """A piece of hardware and the thread that serves it."""

    role: ClassVar[str] = "device"

    label: str = parameter("", "1", "name in messages, logs and on the page; empty: the kind's")
    patience: float = parameter(
        1.0, "s", "nothing heard for this long counts as silent: ten frames of the slowest", gt=0
    )
    retry: float = parameter(0.5, "s", "wait before a lost device is opened again", gt=0)

    _vitals: _Vitals = PrivateAttr(default_factory=_Vitals)
    _receiver: Receiver | None = PrivateAttr(default=None)
    _thread: threading.Thread | None = PrivateAttr(default=None)
    _stopping: threading.Event = PrivateAttr(default_factory=threading.Event)

    @abstractmethod
    def _serve(self) -> None:
        """Open the hardware and deliver what it says until `_stopping` is set.

        Call `_ready` once it is open and `_deliver` for each message; close what was opened in
        every case. Waits must end within 0.2 s of `_stopping`.

        Raises
        ------
        DeviceError
            If it cannot be opened, or fails; it is then opened again after `retry`.
        """

    @property
    def title(self) -> str:
        """Its name in messages, logs and on the page."""
        return self.label or self.name

    def start(self, receiver: Receiver) -> None:
        """Serve the device in a thread of its own; readings go to `receiver`, in that thread."""
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
        self._enter("stopped", "")

    def health(self) -> Health:
        """Return how the device is doing."""
        vitals, moment = self._vitals, now()
        with vitals.lock:
            state, heard = vitals.state, vitals.last
            if state == "ok" and not moment - heard < self.patience:
                state = "silent"
            rates = {
                kind: sum(stamp > moment - RATE_SPAN for stamp in stamps) / RATE_SPAN
                for kind, stamps in vitals.recent.items()
            }
            return Health(state, vitals.detail, rates, dict(vitals.counts), heard)

    def _keep_serving(self) -> None:
        while not self._stopping.is_set():
            self._enter("opening", "")
            try:
                self._serve()
            except DeviceError as error:
                self._lose(str(error))
            except Exception as error:  # a fault of ours must not take the robot down
                log.exception("%s", self.title)
                self._lose(f"{type(error).__name__}: {error}; please report it")
            self._stopping.wait(self.retry)

    def _lose(self, reason: str) -> None:
        with self._vitals.lock:
            news = (self._vitals.state, self._vitals.detail) != ("lost", reason)
        self._count("lost connection")
        self._enter("lost", reason)
        if news:
            self._tell("error", reason)

    def _enter(self, state: State, detail: str) -> None:
        with self._vitals.lock:
            if state == "opening" and self._vitals.state == "lost":
                return  # what is wrong stays to be read until it is right again
            self._vitals.state, self._vitals.detail = state, detail

    def _ready(self, detail: str) -> None:
        """Tell that the device is open and what it is."""
        with self._vitals.lock:
            self._vitals.last = now()
        self._enter("ok", detail)
        self._tell("info", detail)

    def _tell(self, level: Literal["info", "warning", "error"], text: str) -> None:
        """Log an event and deliver it, so that it stands in the recording."""
        self._hand_over(event(self.title, level, text))

    def _count(self, what: str, number: int = 1) -> None:
        """Count something that happened."""
        with self._vitals.lock:
            self._vitals.counts[what] += number

    def _deliver(self, message: Message, arrived: float, device_stamp: float | None = None) -> None:
        """Pass a message on."""
        vitals, kind = self._vitals, type(message).__name__
        with vitals.lock:
            vitals.counts[kind] += 1
            recent = vitals.recent.setdefault(kind, deque(maxlen=512))
            recent.append(arrived)
            vitals.last = arrived
        self._hand_over(Reading(message, arrived, self.title, device_stamp))

    def _hand_over(self, reading: Reading) -> None:
        """Give a reading to the receiver; a fault of the receiver's must not cut the device off."""
        if self._receiver is None:
            return
        try:
            self._receiver(reading)
        except Exception:
            self._count("not received: error")
            if self._vitals.counts["not received: error"] == 1:  # one in words, the rest in number
                log.exception("%s: what receives its readings fails", self.title)


class DriveDevice(Device):
    """A device that moves the robot. Commands may be given from any thread and return at once."""

    @property
    def stopped(self) -> bool:
        """Whether it says that it holds an emergency stop, whoever asked for it."""
        return False

    @abstractmethod
    def drive(self, speed: float, turn_rate: float) -> None:
        """Ask for a speed forward (m/s) and a turn rate (rad/s); the device's own dead man ends it.

        Does nothing but count while the device is lost.
        """

    @abstractmethod
    def emergency_stop(self) -> None:
        """Stop and stay stopped, whatever else is commanded, until `release`; sent until answered."""

    @abstractmethod
    def release(self) -> None:
        """End an emergency stop."""
