"""Version (VV) and parameters (PP) of a SCIP sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.scip_encoding import DamagedError, checksum

_MAX_TEXT = 120  # characters of a field that are kept; the longest known has 45

# Valid values of parameters: requests have four digits for a step, a distance has three characters
# of 6 bits; a turn takes 10 ms to 1 s, in steps of 10 to 0.01 degrees.
_BOUNDS = {
    "DMIN": (0, 2**18 - 1),
    "DMAX": (1, 2**18 - 1),
    "ARES": (36, 36000),
    "AMIN": (0, 9999),
    "AMAX": (0, 9999),
    "AFRT": (0, 9999),
    "SCAN": (60, 6000),
}


def fields(body: tuple[bytes, ...]) -> dict[str, str]:
    """Return the fields of lines "KEY:value;" + checksum, which does not count the semicolon.

    Raises
    ------
    DamagedError
        If a line is damaged.
    """
    found = {}
    for line in body:
        content, semicolon, seal = line.rpartition(b";")
        key, colon, value = content.partition(b":")
        if not semicolon or not colon or len(seal) != 1 or checksum(content) != seal[0]:
            raise DamagedError("a line of the sensor's description is damaged")
        found[key.decode("ascii", "replace")] = value.decode("ascii", "replace").strip()[:_MAX_TEXT]
    return found


def to_line(key: str, value: str) -> bytes:
    """Return a field as a sensor sends it."""
    content = f"{key}:{value}".encode("ascii")
    return b"%b;%c\n" % (content, checksum(content))


@dataclass(frozen=True, slots=True)
class Version:
    """VV: product, firmware and serial number."""

    product: str
    firmware: str
    serial: str

    @classmethod
    def of(cls, body: tuple[bytes, ...]) -> Version:
        """Read the answer to VV; missing fields are empty."""
        content = fields(body)
        return cls(*(content.get(key, "") for key in ("PROD", "FIRM", "SERI")))


@dataclass(frozen=True, slots=True)
class MeasurementParameters:
    """PP: parameters of the measurement.

    Attributes
    ----------
    model : name of the model
    shortest, longest : valid distances, mm
    steps : steps of a whole turn, counted counter-clockwise seen from above
    first, last : steps between which it measures
    front : step along the sensor's x axis
    speed : of the motor, rpm
    """

    model: str
    shortest: int
    longest: int
    steps: int
    first: int
    last: int
    front: int
    speed: int

    @classmethod
    def of(cls, body: tuple[bytes, ...]) -> MeasurementParameters:
        """Read the answer to PP.

        Raises
        ------
        DamagedError
            If a line is damaged.
        DeviceError
            If a parameter is missing, not a number, or impossible.
        """
        content = fields(body)
        values = cls(content.get("MODL", ""), *(_number(content, key) for key in _BOUNDS))
        if values.shortest >= values.longest:
            raise DeviceError(
                f"the sensor reports DMIN {values.shortest} and DMAX {values.longest}, which leaves "
                "no distance to measure; is it a SCIP 2.0 range finder?"
            )
        if not values.first < values.last < values.first + values.steps:
            raise DeviceError(
                f"the sensor reports measuring from step {values.first} to {values.last} of "
                f"{values.steps} a turn, which is impossible; is it a SCIP 2.0 range finder?"
            )
        return values

    @property
    def turn(self) -> float:
        """Time of a turn, s."""
        return 60.0 / self.speed

    @property
    def step_time(self) -> float:
        """Time from a step to the next, s."""
        return self.turn / self.steps

    @property
    def step_angle(self) -> float:
        """Angle from a step to the next, rad."""
        return 2.0 * math.pi / self.steps


def _number(content: dict[str, str], key: str) -> int:
    text, (low, high) = content.get(key, ""), _BOUNDS[key]
    if not (text.isdigit() and len(text) < 10 and low <= int(text) <= high):
        raise DeviceError(
            f"the sensor reports {key} = {text!r}, expected a number from {low} to {high}; "
            "is it a SCIP 2.0 range finder?"
        )
    return int(text)
