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
    """What a message shows: the scan (None for sensors that have none) and the observations."""

    scan: Scan | None
    observations: tuple[Observation, ...]


class Sensor(Component):
    """An exteroceptive sensor. Extractors hang on it; it owns its mount, limits and noise."""

    role: ClassVar[str] = "sensor"
    consumes: ClassVar[type]
    """The type of message it understands."""

    def delay(self) -> float:
        """Return how much later than the measurement its stamp is, on the odometry's clock, s."""
        return 0.0

    @abstractmethod
    def observe(
        self, message: Message, twist: Array, rng: np.random.Generator, look: bool = True
    ) -> Reading:
        """Return what the message shows in base_link as it is at the message's stamp.

        Without `look` the scan is made ready but not searched for landmarks.

        `twist` (3,) is the body's [vx, vy, omega] (m/s, m/s, rad/s) from the stamp on, for the
        removal of motion distortion.

        Raises
        ------
        MessageError
            If the message cannot be used at all.
        """

    def duration(self, message: Message) -> float:
        """Return how long after its stamp the measurement went on, in s."""
        del message
        return 0.0
