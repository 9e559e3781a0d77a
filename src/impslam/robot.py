"""The robot: what it feels of its own motion, and what it sees (thesis 5.1, Fig. 22).

Proprioceptive sensing is one odometry; exteroceptive sensors carry the extractors that look for
landmarks in their data. A sensor or an extractor is added by a table in the config, not by code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from impslam.odometry.base import Odometry
from impslam.sensors.base import Sensor
from impslam.types import Message


@dataclass(frozen=True, slots=True)
class Robot:
    """One odometry and any number of exteroceptive sensors by name."""

    name: str
    odometry: Odometry
    sensors: Mapping[str, Sensor]

    def feels(self, message: Message) -> bool:
        """Tell whether the odometry understands a message."""
        return isinstance(message, self.odometry.consumes)

    def sensor_for(self, message: Message) -> Sensor | None:
        """Return the sensor that understands a message, if any."""
        for sensor in self.sensors.values():
            if isinstance(message, sensor.consumes):
                return sensor
        return None
