"""Values passed between parts: messages, increments, scans, observations, matches, landmarks.

All are frozen; their arrays are float64 (bool or int64 where stated) and must not be written to.
Metres, radians, seconds; x forward, y left, yaw counter-clockwise (REP 103); frames map, odom,
base_link and laser (REP 105).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypeVar, TypeVarTuple, Unpack

import numpy as np
import numpy.typing as npt

from impslam.errors import ShapeError

Array: TypeAlias = npt.NDArray[np.float64]
Ints: TypeAlias = npt.NDArray[np.int64]
Mask: TypeAlias = npt.NDArray[np.bool_]
T = TypeVar("T")
Ts = TypeVarTuple("Ts")


def check_shape(name: str, array: npt.NDArray[np.generic], *shape: int | None) -> None:
    """Raise `ShapeError` unless the array has this shape; None means any length."""
    if array.ndim != len(shape) or any(
        expected is not None and expected != length
        for expected, length in zip(shape, array.shape, strict=True)
    ):
        wanted = str(shape).replace("None", "any")
        raise ShapeError(f"{name} has shape {array.shape}; expected {wanted}")


# --------------------------------------------------------------------------- messages


@dataclass(frozen=True, slots=True, eq=False)
class Stamped:
    """A message: a measurement or an event at `stamp`, in s on the host's clock."""

    layout_fields: ClassVar[tuple[str, ...]] = ()
    """Fields that a device sets once for all its messages."""

    stamp: float


@dataclass(frozen=True, slots=True, eq=False)
class WheelAngles(Stamped):
    """Readings of the left and the right wheel encoder at `stamp`.

    In the encoder's own unit: accumulated ticks, an accumulated angle in rad, or the voltage of an
    absolute encoder that wraps once a turn, depending on the parameters of the odometry.
    """

    left: float
    right: float


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPose(Stamped):
    """`T_odom_base` (3,) from the robot's own odometry."""

    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class Velocity(Stamped):
    """Forward speed in m/s and turn rate in rad/s, valid from `stamp` until the next message."""

    speed: float
    turn_rate: float


@dataclass(frozen=True, slots=True, eq=False)
class Steering(Stamped):
    """A car's wheel speed in m/s and steering angle in rad (left positive), valid until the next one."""

    speed: float
    angle: float


@dataclass(frozen=True, slots=True, eq=False)
class Imu(Stamped):
    """Angular velocity (3,) rad/s, linear acceleration (3,) m/s^2, orientation quaternion xyzw."""

    angular_velocity: Array
    linear_acceleration: Array
    orientation: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Image(Stamped):
    """One compressed camera picture; `format` is "jpeg" or "png"."""

    format: str
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan(Stamped):
    """One raw sweep of a 2D lidar: n beams, for any n, direction of rotation and start angle.

    `angles` (n,) are in the laser frame, counter-clockwise about its +z, 0 along its +x;
    `time_offsets` (n,) is the time of each beam after `stamp`, which is that of beam 0;
    `ranges` (n,) are as received: 0, NaN, inf, negative and error codes included.
    `range_min` and `range_max` are those of the message, NaN if it has none.
    `intensities` (n,) are the brightness of the echoes in the device's own unit, or None.
    """

    layout_fields: ClassVar[tuple[str, ...]] = ("angles", "time_offsets", "range_min", "range_max")

    angles: Array
    ranges: Array
    time_offsets: Array
    range_min: float = float("nan")
    range_max: float = float("nan")
    intensities: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.ranges)
        check_shape("LaserScan.ranges", self.ranges, n)
        check_shape("LaserScan.angles", self.angles, n)
        check_shape("LaserScan.time_offsets", self.time_offsets, n)
        if self.intensities is not None:
            check_shape("LaserScan.intensities", self.intensities, n)


def range_limits(low: float, high: float) -> tuple[float, float]:
    """Return the limits of a scan's ranges as given, or NaN for both if no range is within them.

    Drivers that do not know their lidar leave `range_max` at 0; then `range_min` is no better known.
    """
    return (math.nan, math.nan) if high <= max(0.0, low) else (low, high)


@dataclass(frozen=True, slots=True, eq=False)
class Detections(Stamped):
    """Landmarks that a sensor detected itself at `stamp`, as range and bearing in its own frame.

    `ranges` (n,) m; `bearings` (n,) rad, counter-clockwise about +z, 0 along +x; `labels` (n,) int64
    are their identities, -1 if unknown; `diameters` (n,) m, NaN if not measured.
    """

    ranges: Array
    bearings: Array
    labels: Ints
    diameters: Array

    def __post_init__(self) -> None:
        n = len(self.ranges)
        check_shape("Detections.ranges", self.ranges, n)
        check_shape("Detections.bearings", self.bearings, n)
        check_shape("Detections.labels", self.labels, n)
        check_shape("Detections.diameters", self.diameters, n)


@dataclass(frozen=True, slots=True, eq=False)
class TruePose(Stamped):
    """`T_map_base` (3,) from a simulator or a tracking system; for scoring, never for the filter.

    The heading is NaN if only the position was tracked.
    """

    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class Fix(Stamped):
    """A GPS fix: (2,) m east and north of a nearby origin, and its covariance (2, 2), NaN if unknown."""

    position: Array
    covariance: Array


NO_FIX, FIX, SATELLITES, GROUND = -1, 0, 1, 2
"""Statuses of a `SatelliteFix`, as of `sensor_msgs/NavSatStatus`: none, one, one with corrections from
satellites or from the ground."""


@dataclass(frozen=True, slots=True, eq=False)
class SatelliteFix(Stamped):
    """A fix of a satellite receiver: WGS 84 latitude and longitude in degrees, altitude in m.

    `altitude` is above the ellipsoid. `covariance` (3, 3) m^2 is of east, north, up, NaN if unknown.
    `status` is one of the above; with `NO_FIX` the position is meaningless.
    """

    latitude: float
    longitude: float
    altitude: float
    covariance: Array
    status: int = FIX

    def __post_init__(self) -> None:
        check_shape("SatelliteFix.covariance", self.covariance, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class EncoderVoltages(Stamped):
    """Voltages of the left and the right absolute encoder: 0 to 5 V over a turn, wrapping."""

    left: float
    right: float


@dataclass(frozen=True, slots=True, eq=False)
class Acceleration(Stamped):
    """Linear acceleration (3,) m/s^2 of a second accelerometer, in the IMU's frame."""

    linear_acceleration: Array


@dataclass(frozen=True, slots=True, eq=False)
class MagneticField(Stamped):
    """Magnetic field (3,) T, in the IMU's frame."""

    field: Array


@dataclass(frozen=True, slots=True, eq=False)
class Climate(Stamped):
    """Temperature in degrees Celsius and relative humidity in [0, 1]."""

    temperature: float
    humidity: float


@dataclass(frozen=True, slots=True, eq=False)
class DeviceTime(Stamped):
    """A device's own clock, in s since it started (unwrapped), at `stamp` on the host's clock."""

    device: str
    device_stamp: float


@dataclass(frozen=True, slots=True, eq=False)
class Event(Stamped):
    """An event that is not a measurement: a lost device, a fault, an emergency stop.

    `level` is "info", "warning" or "error"; `source` is the device or part that reports it.
    """

    level: str
    source: str
    text: str


Message: TypeAlias = Stamped


# --------------------------------------------------------------------------- estimation


class SystematicPart(NamedTuple):
    """The systematic errors of a motion by odometry.

    Attributes
    ----------
    errors : (3, k) error of `d_pose`, one column per standard deviation of each of k constant errors
    replaced : (3, 3) the part of the motion's covariance that stands for them in filters that take all
        errors as random
    correlation : (k,) of each error with the same one of the previous increment
    learned : (k,) whether it is estimated; the others are only considered
    """

    errors: Array
    replaced: Array
    correlation: Array
    learned: Mask


class ErrorEstimate(NamedTuple):
    """What a filter knows of the systematic errors of odometry; see `SystematicPart`.

    Attributes
    ----------
    means, sigmas : (k,) in the standard deviations of `SystematicPart.errors`
    """

    means: Array
    sigmas: Array


@dataclass(frozen=True, slots=True, eq=False)
class Increment:
    """Motion of base_link since the previous increment, relative to its pose at the start.

    `d_pose` (3,) is `T_before_after`; `covariance` (3, 3) is that of its additive error;
    `duration` >= 0 is in seconds and `stamp` is the time at its end. `systematic` describes the part of
    the error that stays the same or changes slowly, for filters that consider it.
    """

    stamp: float
    d_pose: Array
    covariance: Array
    duration: float = 0.0
    systematic: SystematicPart | None = None

    @property
    def random(self) -> Array:
        """Covariance (3, 3) of the error without the systematic part."""
        return (
            self.covariance
            if self.systematic is None
            else self.covariance - self.systematic.replaced
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A sweep ready for extraction: validated, mounted, and de-skewed to its middle.

    n beams in beam order, every array of length n. `points`, `directions` and `origins` are in
    base_link at that time. Only beams with `valid` true have a meaningful range and point.

    Attributes
    ----------
    angles : (n,) rad, about the z axis of base_link, 0 ahead of the laser; of a laser that is upside down,
        those in its own frame with the opposite sign
    ranges : (n,) m
    valid : (n,) bool
    points : (n, 2) m, end point of the beam
    directions : (n,) rad, direction of the beam
    origins : (n, 2) m, start of the beam (differs between beams of a moving robot)
    sigmas : (n,) m, standard deviation of the range noise, independent between beams
    bias : m, standard deviation of the error that all beams of this sensor share
    range_max : the largest range that the sensor measures, in its own unit: before scale and offset
    laser : (3,) `T_base_laser`
    intensities : (n,) brightness of the echoes, in the device's unit, or None
    derived : cached results of `derive`; empty in a scan made by `replace`
    """

    stamp: float
    angles: Array
    ranges: Array
    valid: Mask
    points: Array
    directions: Array
    origins: Array
    sigmas: Array
    bias: float
    range_max: float
    laser: Array
    intensities: Array | None = None
    derived: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)

    def derive(self, compute: Callable[[Scan, Unpack[Ts]], T], *parameters: *Ts) -> T:
        """Return `compute(self, *parameters)`, cached so that extractors share one result.

        `compute` must be pure, and its result must not be written to. Results are kept as long as the scan.
        """
        key = compute, parameters
        if key not in self.derived:
            self.derived[key] = compute(self, *parameters)
        result: T = self.derived[key]
        return result


_NO_BEAMS: Ints = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """A landmark observed in one scan, in base_link at the scan's stamp.

    Kinds and their z:

    - "cylinder", "corner" (points): z = [x, y] of the centre (of the corner), m.
    - "wall" (line): z = [rho, alpha], m and rad: the wall is {p : p . n(alpha) = rho} with
      n(alpha) = (cos alpha, sin alpha) pointing *into* the wall, away from the side that the laser
      sees. rho is signed: negative once base_link (not the laser) is behind the wall's line.

    Attributes
    ----------
    kind : the landmark model this belongs to
    z, R : (k,) and (k, k), measurement and its covariance
    beams : indices of the beams used, int64
    end_points : (2, 2) m, first and last point of a wall along increasing beam index, else None
    attributes : further measured properties by name, e.g. {"radius": 0.15} (m)
    label : the landmark's identity if the sensor reads it (barcodes), else None
    delay : s, mean time of its beams after the scan's stamp (signed)
    shared : (k,) error of z if the error common to all readings of its sensor is one standard
        deviation; R includes it. None: no common error
    sensor : the sensor with that error
    """

    kind: str
    z: Array
    R: Array
    beams: Ints = field(default_factory=lambda: _NO_BEAMS)
    end_points: Array | None = None
    attributes: Mapping[str, float] = field(default_factory=dict)
    label: int | None = None
    delay: float = 0.0
    shared: Array | None = None
    sensor: str = ""

    def with_noise(self, R: Array) -> Observation:
        """Return the observation with another R (k, k), four times as fast as `replace`."""
        return Observation(
            self.kind, self.z, R, self.beams, self.end_points, self.attributes, self.label,
            self.delay, self.shared, self.sensor,
        )  # fmt: skip

    def without_beams(self) -> Observation:
        """Return the observation without beam indices, which are meaningless without the scan."""
        return Observation(
            self.kind, self.z, self.R, _NO_BEAMS, self.end_points, self.attributes, self.label,
            self.delay, self.shared, self.sensor,
        )  # fmt: skip

    def of_sensor(self, sensor: str, delay: float) -> Observation:
        """Return the observation with another sensor and delay, s."""
        return Observation(
            self.kind, self.z, self.R, self.beams, self.end_points, self.attributes, self.label,
            delay, self.shared, sensor,
        )  # fmt: skip


class Innovation(NamedTuple):
    """The joint innovation of all matched observations of a scan.

    Attributes
    ----------
    nis : nu^T S^-1 nu of the stacked innovation, with the correlations due to the common pose
    dof : its number of scalars, i.e. of degrees of freedom: the mean of `nis` if S is right
    log_det : log det S, with S in m^2 and rad^2
    """

    nis: float
    dof: int
    log_det: float


class Match(NamedTuple):
    """An observation matched to a landmark: innovation (k,), its covariance S (k, k), and d^2."""

    observation: int
    landmark: int
    innovation: Array
    S: Array
    distance2: float


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """An estimated landmark: position in map, parameters, covariance and history.

    `position` (2,) is a point's centre or a wall's foot of the normal from the map origin (thesis
    Fig. 20). `covariance` (2, 2) is that of the estimated `parameters`: x, y of a point,
    [r, alpha] of a wall. `end_points` (2, 2) m in map for walls, else None.
    """

    id: int
    kind: str
    position: Array
    parameters: Mapping[str, float]
    covariance: Array
    end_points: Array | None
    observations: int
    first_stamp: float
    last_stamp: float

    @property
    def is_line(self) -> bool:
        """Whether it is a line, with the parameters r and alpha; otherwise it is a point."""
        return "r" in self.parameters and "alpha" in self.parameters


@dataclass(frozen=True, slots=True, eq=False)
class TrueLandmark:
    """The true state of a landmark; for scoring, never for the filter.

    `position` (2,) m is a centre, or the foot of the normal from the map's origin; `parameters` are
    like those of `Landmark`; `end_points` (2, 2) m for walls, else None.
    """

    name: str
    kind: str
    position: Array
    parameters: Mapping[str, float]
    end_points: Array | None = None


class Edges(NamedTuple):
    """Measured relative poses.

    Attributes
    ----------
    i, j : (e,) int64, indices of the poses
    T_i_j : (e, 3)
    information : (e, 3, 3) inverse of the covariance of the additive error of T_i_j
    kernel : (e,) c^2 > 0, the chi-square at which an edge's weight is a quarter; inf: always 1
    """

    i: Ints
    j: Ints
    T_i_j: Array
    information: Array
    kernel: Array

    def joined(self, more: Edges) -> Edges:
        """Return these edges and more between the same poses."""
        pairs = zip(self, more, strict=True)
        i, j, T_i_j, information, kernel = (np.concatenate(pair) for pair in pairs)
        return Edges(i, j, T_i_j, information, kernel)


_NONE = np.empty(0, np.int64)
NO_COVARIANCE = np.empty((0, 0))
"""The joint covariance of no landmarks, or an unknown one."""
NO_EDGES = Edges(_NONE, _NONE, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))
