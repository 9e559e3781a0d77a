"""The interface of exteroceptive sensors, which turn rows into scans and observations (thesis 5.1)."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Scans, Sweeps
from impslam.component import Component, parameter
from impslam.types import Array, Mask, Message, Observation


class Sensor(Component):
    """An exteroceptive sensor with its mount, limits, noise and extractors."""

    role: ClassVar[str] = "sensor"
    consumes: ClassVar[type[Message]]
    """The type of message that it reads."""

    observes_unique: ClassVar[bool] = False
    """Whether it observes a landmark that exists only once, which not every estimator supports."""

    row_name: ClassVar[str] = "scan"
    """Name of one of its rows in messages about unusable rows."""

    stream: str = parameter(
        "", "", "name of the stream that it reads; empty: the default stream of its kind"
    )

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the start and end of each row's measurement, (m,) s on the odometry's clock.

        Called once for each row, in order, so that a sensor can smooth its stamps.
        """
        return columns.stamps, columns.stamps

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which rows can be used."""
        return np.ones(len(columns), np.bool_)

    def fault(self, message: Message) -> str:
        """Return one line that describes why a row is unusable, and how it is handled."""
        raise NotImplementedError

    @abstractmethod
    def sweeps(self, columns: Columns, twists: Array) -> Scans | None:
        """Return usable rows as scans in base_link at the middle of their spans, or None.

        `twists` (m, 3) are the mean body velocities [vx, vy, omega] (m/s, m/s, rad/s) over the spans,
        for de-skewing. Sensors that do not measure scans return None.
        """

    @abstractmethod
    def observe(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Extract the landmarks in row k of the sweeps, in base_link at the middle of the sweep."""
