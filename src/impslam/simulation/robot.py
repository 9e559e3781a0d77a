"""The simulated robot: wheels with encoders, a lidar and an inertial unit, with their faults.

Every fault can be switched off with a standard deviation (or rate) of zero, and all of them with
`perfect()`. Each device has its own random streams, so that switching one off does not change the others.
"""

from __future__ import annotations

import math
from typing import Any, Self

from pydantic import model_validator

from impslam.parameters import Parameters, parameter
from impslam.simulation.world import Span

_STEP = 2 * math.pi / 1024  # rad, angular step of the URG-04LX


class SimulatedDevice(Parameters):
    """A part of the simulated robot."""


class WheelEncoders(SimulatedDevice):
    """Two absolute magnetic encoders (MA3) on passive wheels, read as accumulated angles in rad.

    The faults: rotation lost in turns, when four driven wheels skid and drag the passive ones sideways;
    uneven ground, with an error that grows as the square root of the distance; errors of radii and track
    that remain after calibration (radius errors bend straight paths, so they must be far smaller than that
    of the track); wheels that stick occasionally (thesis 3.5); 12-bit readings. With the defaults, dead
    reckoning ends with an error of about 0.4 m in the arena (18 m, 14 rad) and about 13 m in the corridor
    (117 m).
    """

    wheel_radius: float = parameter(0.0635, "m", "nominal radius (5 in wheels)", gt=0.0)
    track: float = parameter(0.40, "m", "nominal distance of the wheels (not in the thesis)", gt=0)
    rate: float = parameter(100.0, "Hz", "rows sent to the computer", gt=0.0)
    counts: int = parameter(4096, "1", "readings per turn (MA3, 12 bit); 0: continuous", ge=0)
    voltages: bool = parameter(
        False, "1", "also record the absolute encoders' output: 0 to 5 V per turn, wrapping"
    )
    radius_sigma: float = parameter(
        0.001, "1", "relative error of each radius: 0.06 mm, left by calibration", ge=0.0
    )
    track_sigma: float = parameter(
        0.02, "1", "relative error of the track: 8 mm, where a wide wheel touches", ge=0.0
    )
    noise: float = parameter(
        1e-4, "m^2/m", "variance of a wheel's travel per distance: 1 cm after 1 m", ge=0.0
    )
    slip_sigma: float = parameter(
        0.06, "1", "share of the rotation lost in a turn, half-normal, drawn per turn", ge=0.0
    )
    turn_rate: float = parameter(0.15, "rad/s", "minimum rate that counts as a turn", gt=0.0)
    skid_rate: float = parameter(0.02, "1/m", "how often a wheel sticks, per wheel", ge=0.0)
    skid_length: float = parameter(
        0.01, "m", "mean distance over which it then does not turn", ge=0.0
    )

    @classmethod
    def perfect(cls, **other: Any) -> Self:
        """Return encoders without faults."""
        faults = ("counts", "radius_sigma", "track_sigma", "noise", "slip_sigma", "skid_rate")
        return cls(**{**dict.fromkeys(faults, 0), **other})


class Lidar(SimulatedDevice):
    """Hokuyo URG-04LX: 682 beams of 1024 steps per turn, counter-clockwise, 10 Hz.

    The data sheet's +-10 mm (up to 1 m) and 1 % (up to 4 m) are accuracy, mostly an error that all beams
    share. The noise from scan to scan is smaller: a few millimetres, growing with range as the reflected
    light gets weaker.
    """

    mount: tuple[float, float, float] = parameter((0.15, 0.0, 0.0), "m, m, rad", "T_base_laser")
    beams: int = parameter(682, "1", "number of beams (steps 44 to 725)", ge=2)
    angle_min: float = parameter(-340 * _STEP, "rad", "direction of beam 0 (step 44, front 384)")
    angle_step: float = parameter(_STEP, "rad", "angle from beam to beam; negative: clockwise")
    beam_time: float = parameter(97.66e-6, "s", "time from beam to beam (100 ms / 1024)", ge=0.0)
    rate: float = parameter(10.0, "Hz", "sweep rate", gt=0.0)
    range_min: float = parameter(0.02, "m", "minimum range", ge=0.0)
    range_max: float = parameter(5.6, "m", "maximum range", gt=0.0)
    no_return: float = parameter(0.0, "m", "reading of a beam without an echo", special="nan inf")
    sigma: float = parameter(0.003, "m", "range noise, constant part", ge=0.0)
    sigma_rate: float = parameter(0.003, "m/m", "range noise, part that grows with range", ge=0.0)
    bias_sigma: float = parameter(
        0.003, "m", "error shared by all beams of a run: a third of the data sheet's 10 mm", ge=0.0
    )
    resolution: float = parameter(0.001, "m", "ranges are multiples of this; 0: continuous", ge=0)
    divergence: float = parameter(
        0.010, "rad", "beam width (20 mm at 2 m): mixed pixels at edges; 0: none", ge=0.0
    )
    edge: float = parameter(0.05, "m", "minimum range jump at which a beam mixes surfaces", gt=0.0)
    grazing: float = parameter(
        math.radians(85), "rad", "angle of incidence beyond which there is no echo", gt=0.0
    )
    dropout: float = parameter(0.002, "1", "share of beams lost at random", ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _check_sweep(self) -> Self:
        """Raise if a sweep would begin before the previous one ends, or see a direction twice."""
        sweep, period = (self.beams - 1) * self.beam_time, 1.0 / self.rate
        if sweep > period:
            raise ValueError(
                f"a sweep of {self.beams} beams takes {sweep:.3g} s, longer than the {period:.3g} s from "
                "sweep to sweep; reduce rate, beams or beam_time"
            )
        view = (self.beams - 1) * abs(self.angle_step)
        if not 0.0 < view <= 2.0 * math.pi + 1e-6:
            raise ValueError(
                f"{self.beams} beams with an angle_step of {self.angle_step:.6g} rad cover {view:.3g} rad; "
                "they must cover more than 0 and at most a full turn, 6.28 rad"
            )
        return self

    @classmethod
    def perfect(cls, **other: Any) -> Self:
        """Return a lidar without faults, but with its limits and time per beam."""
        faults = ("sigma", "sigma_rate", "bias_sigma", "resolution", "divergence", "dropout")
        return cls(**{**dict.fromkeys(faults, 0), "grazing": math.pi, **other})


class InertialUnit(SimulatedDevice):
    """A MEMS gyro and accelerometer at base_link, each averaged over its sampling period."""

    rate: float = parameter(100.0, "Hz", "sampling rate", gt=0.0)
    gyro_sigma: float = parameter(0.004, "rad/s", "noise (0.03 deg/s/sqrt(Hz), 50 Hz)", ge=0.0)
    gyro_bias_sigma: float = parameter(0.005, "rad/s", "constant error, drawn per run", ge=0.0)
    gravity: float = parameter(9.80665, "m/s^2", "reading of the upward axis at rest", ge=0.0)
    accel_sigma: float = parameter(0.02, "m/s^2", "noise", ge=0.0)
    accel_bias_sigma: float = parameter(0.05, "m/s^2", "constant error, drawn per run", ge=0.0)

    @classmethod
    def perfect(cls, **other: Any) -> Self:
        """Return an inertial unit without faults."""
        faults = ("gyro_sigma", "gyro_bias_sigma", "accel_sigma", "accel_bias_sigma")
        return cls(**{**dict.fromkeys(faults, 0), **other})


class OnboardCamera(SimulatedDevice):
    """The camera on the robot (thesis 3.3.1: 5 MP, 72 deg by 30 deg, logged at 5 Hz).

    The default has the same field of view with fewer pixels: 5 MP are width = 3648 and height = 1368.
    """

    rate: float = parameter(5.0, "Hz", "picture rate", gt=0.0)
    width: int = parameter(640, "px", "width of the picture", ge=16, le=8192)
    height: int = parameter(240, "px", "height of the picture", ge=16, le=8192)
    field: float = parameter(math.radians(72.0), "rad", "horizontal field of view", gt=0.1, lt=3.0)
    above_floor: float = parameter(0.35, "m", "height of the lens", gt=0.0)
    forward: float = parameter(0.15, "m", "distance in front of base_link", ge=-2.0, le=2.0)
    quality: int = parameter(85, "1", "JPEG quality", ge=1, le=100)


class OverheadCamera(SimulatedDevice):
    """A camera under the ceiling that films the run: the ground truth of the thesis (5.2)."""

    width: int = parameter(1920, "px", "width of the picture", ge=64, le=7680)
    height: int = parameter(1080, "px", "height of the picture", ge=64, le=4320)
    focal: float = parameter(1300.0, "px", "focal length: 73 deg across", gt=0.0)
    above: float = parameter(5.0, "m", "height above the floor", gt=2.0)
    tilt: tuple[float, float] = parameter((0.03, -0.02), "rad", "tilt from the vertical")
    distortion: tuple[float, float, float, float] = parameter(
        (-0.12, 0.02, 0.0005, -0.0005), "1", "k1, k2, p1, p2 of the lens"
    )
    rate: float = parameter(10.0, "Hz", "picture rate", gt=0.0, le=240.0)
    exposure: float = parameter(0.01, "s", "exposure time", ge=0.0)
    blur: float = parameter(0.8, "px", "blur of the lens, standard deviation", ge=0.0)
    noise: float = parameter(3.0, "1", "noise in grey levels of 255, standard deviation", ge=0.0)
    survey_sigma: float = parameter(0.002, "m", "error of lengths measured by tape", ge=0.0)
    marker_size: float = parameter(0.10, "m", "size of the marker on the robot", gt=0.0)
    marker_height: float = parameter(0.20, "m", "height of the marker above the floor", gt=0.0)
    hidden: tuple[Span, ...] = parameter(
        (), "s", "times [from, until] at which the robot is covered"
    )


class SimulatedRobot(SimulatedDevice):
    """The robot of the thesis; None removes a device."""

    encoders: WheelEncoders | None = WheelEncoders()
    lidar: Lidar | None = Lidar()
    imu: InertialUnit | None = InertialUnit()
    camera: OnboardCamera | None = None
    overhead: OverheadCamera = OverheadCamera()
    start_time: float = parameter(1000.0, "s", "stamp of the first message", ge=0.0)
    truth_rate: float = parameter(
        100.0, "Hz", "rate of true poses, besides those at scan stamps", gt=0
    )

    @classmethod
    def perfect(cls) -> Self:
        """Return the robot without faults."""
        return cls(
            encoders=WheelEncoders.perfect(), lidar=Lidar.perfect(), imu=InertialUnit.perfect()
        )
