"""The role of odometry: proprioceptive messages in, increments of motion out (thesis 3.5)."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from impslam.component import Component
from impslam.errors import MessageError
from impslam.types import Increment, Message


class Odometry(Component):
    """Turns messages into increments that compose; it keeps only what the last message left."""

    role: ClassVar[str] = "odometry"
    consumes: ClassVar[type]
    """The type of message it understands."""

    @abstractmethod
    def update(self, message: Message) -> Increment | None:
        """Return the motion since the previous message, or None for the first one.

        Raises
        ------
        MessageError
            If the message cannot be used (not finite, an impossible jump); the state is then that
            of a fresh start at the message's reading, so that the next increment is sound.
        """


def held_for(last: float, stamp: float, longest: float, what: str) -> float:
    """Return how long (s) a reading has held, for odometry whose readings hold until the next one.

    Raises
    ------
    MessageError
        If that is more than `longest`: whether it held on is then not known.
    """
    duration = max(stamp - last, 0.0)
    if duration > longest:
        raise MessageError(
            f"no {what} for {duration:.3g} s before {stamp:.3f} s; the motion in between is left "
            "out: check the log, or raise odometry.max_hold"
        )
    return duration
