"""The role of an exteroceptive sensor: its rows in, what they show of the world out (thesis 5.1)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Scans, Sweeps
from impslam.component import Component, parameter
from impslam.types import Array, Mask, Message, Observation, Scan


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
    consumes: ClassVar[type[Message]]
    """The type of message it understands."""

    stream: str = parameter(
        "", "", "name of the stream it reads; empty: the default stream of its kind"
    )

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return when the rows' measurements began and ended, (m,) s on the odometry's clock.

        Asked once for each row, in order: a sensor may smooth its stamps.
        """
        return columns.stamps, columns.stamps

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which rows can be used at all."""
        return np.ones(len(columns), np.bool_)

    def fault(self, message: Message) -> str:
        """Say in one line why a row cannot be used, and what becomes of it."""
        raise NotImplementedError

    @abstractmethod
    def sweeps(self, columns: Columns, twists: Array) -> Scans | None:
        """Return usable rows in base_link as it is in the middle of their spans, if they are scans.

        `twists` (m, 3) are the body's mean [vx, vy, omega] (m/s, m/s, rad/s) over the spans, for the
        removal of motion distortion.
        """

    @abstractmethod
    def look(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the landmarks that row k of the sweeps shows, in base_link in its middle."""
