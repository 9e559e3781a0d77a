"""The interface of exteroceptive sensors, which turn rows into scans and observations (thesis 5.1)."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, TypeAlias

import numpy as np
from pydantic import AfterValidator

from impslam.columns import Columns, Scans, Sweeps
from impslam.component import Component, parameter
from impslam.types import Array, Mask, Message, Observation

MAX_OFFSET = 20.0
"""m: no vehicle carries a sensor farther from its wheels; it may be in millimetres, or a pose in a map."""


def _is_on_vehicle(mount: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(abs(mount[0]), abs(mount[1])) > MAX_OFFSET:
        raise ValueError(f"must be within {MAX_OFFSET:g} m of base_link (metres, not millimetres)")
    return mount


Mount: TypeAlias = Annotated[tuple[float, float, float], AfterValidator(_is_on_vehicle)]
"""Pose [x, y, yaw] of a sensor in base_link, m and rad."""


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
