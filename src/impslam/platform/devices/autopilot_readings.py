"""Convert the autopilot's readings to messages in SI units."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.platform.devices.autopilot_messages import ADC_STEPS, ADC_VOLTS, Hello, Sensors
from impslam.platform.devices.wheel_counter import WheelCounter
from impslam.types import (
    Acceleration,
    Array,
    Climate,
    EncoderVoltages,
    Imu,
    MagneticField,
    Message,
    WheelAngles,
)

CLIMATE_INTERVAL = 1.0  # s; a room changes slowly


class Readings:
    """Converts readings to messages; wheel angles stay continuous across reboots and wraps.

    Parameters
    ----------
    counts_per_turn : of the accumulators
    """

    def __init__(self, counts_per_turn: int) -> None:
        self._left = WheelCounter(counts_per_turn, ADC_STEPS)
        self._right = WheelCounter(counts_per_turn, ADC_STEPS)
        self._climate_at = -math.inf

    def restart(self) -> None:
        """Handle a restart of the accumulators."""
        self._left.restart()
        self._right.restart()

    def follow(self, sensors: Sensors) -> tuple[float, float]:
        """Return the angles of the left and right wheel, rad."""
        (left, right), (left_reading, right_reading) = sensors.counts, sensors.voltages
        return self._left(left, left_reading), self._right(right, right_reading)

    def messages(self, sensors: Sensors, hello: Hello, stamp: float) -> Iterator[Message]:
        """Yield the messages of a reading at `stamp`; temperature and humidity once a second at most."""
        left, right = (ADC_VOLTS / ADC_STEPS * reading for reading in sensors.voltages)
        yield WheelAngles(stamp, *self.follow(sensors))
        yield EncoderVoltages(stamp, left, right)
        rates = _scaled(sensors.gyro, hello.gyro)
        yield Imu(stamp, rates, _scaled(sensors.accelerometer, hello.accelerometer))
        yield Acceleration(stamp, _scaled(sensors.accelerometer_2, hello.accelerometer_2))
        yield MagneticField(stamp, _scaled(sensors.magnetometer, hello.magnetometer))
        if stamp - self._climate_at >= CLIMATE_INTERVAL:
            self._climate_at = stamp
            yield Climate(stamp, 1e-2 * sensors.temperature, 1e-4 * sensors.humidity)


def _scaled(steps: tuple[int, int, int], scale: float) -> Array:
    return scale * np.array(steps, dtype=np.float64)
