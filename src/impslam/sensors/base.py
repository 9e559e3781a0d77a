"""The role of an exteroceptive sensor: a message in, what it shows of the world out (thesis 5.1)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from impslam.component import Component
from impslam.types import Array, Message, Observation, Scan


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a message shows: the scan (None for sensors that have none) and the observations.

    `searched` is false where nobody looked for landmarks, so that their absence says nothing.
    """

    scan: Scan | None
    observations: tuple[Observation, ...]
    searched: bool = True


class Sensor(Component):
    """An exteroceptive sensor. Extractors hang on it; it owns its mount, limits and noise."""

    role: ClassVar[str] = "sensor"
    consumes: ClassVar[type]
    """The type of message it understands."""

    @abstractmethod
    def observe(
        self, message: Message, twist: Array, rng: np.random.Generator, look: bool = True
    ) -> Reading:
        """Return what the message shows in base_link as it is in the middle of its `span`.

        Without `look` the scan is made ready but not searched for landmarks.

        `twist` (3,) is the body's mean [vx, vy, omega] (m/s, m/s, rad/s) over the span, for the
        removal of motion distortion.

        Raises
        ------
        MessageError
            If the message cannot be used at all.
        """

    def span(self, message: Message) -> tuple[float, float]:
        """Return when the measurement began and ended, s on the odometry's clock.

        Asked once for each message, in order: a sensor may smooth its stamps.
        """
        return message.stamp, message.stamp
