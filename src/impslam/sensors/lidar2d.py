"""A 2D lidar: turns its messages into de-skewed scans in base_link; the geometry is in `deskewing`."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, field_validator

from impslam.columns import Columns, Scans, Sweeps, single_row
from impslam.component import build, parameter, register
from impslam.extractors.base import Extractor
from impslam.geometry.kernels import plain
from impslam.sensors.base import Mount, Sensor
from impslam.sensors.clock import SweepClock
from impslam.sensors.deskewing import RangeCalibration, deskew_sweeps
from impslam.types import Array, LaserScan, Mask, Message, Observation, Scan, range_limits


@register("lidar2d")
class Lidar2D(Sensor):
    """A 2D lidar and its extractors."""

    consumes: ClassVar[type[Message]] = LaserScan

    mount: Mount = parameter(
        (0.0, 0.0, 0.0), "m, m, rad", "pose [x, y, yaw] of the laser in base_link"
    )
    upside_down: bool = parameter(False, "", "the laser is mounted with its z axis pointing down")
    range_min: float = parameter(
        math.nan, "m", "shorter ranges are invalid; nan: the limit in the messages"
    )
    range_max: float = parameter(
        math.nan, "m", "longer ranges are invalid; nan: the limit in the messages"
    )
    angle_min: float = parameter(
        -math.pi,
        "rad",
        "beams to the right of this (laser frame) are invalid, e.g. the robot's body",
    )
    angle_max: float = parameter(
        math.pi,
        "rad",
        "beams to the left of this (laser frame) are invalid; below angle_min: the field of view "
        "contains the direction backward",
    )
    sigma: float = parameter(
        0.01, "m", "standard deviation of the range noise at range 0", gt=0, le=100, noise=True
    )
    sigma_per_m: float = parameter(
        0.0, "1", "increase of that standard deviation per metre of range", ge=0, le=1, noise=True
    )
    bias: float = parameter(
        0.0, "m", "standard deviation of the range error common to all beams", ge=0, le=100
    )  # not `noise`: an error common to all scans is in the map, and no innovation shows it
    range_scale: float = parameter(
        1.0, "1", "true range over measured range, from a calibration", gt=0
    )
    range_offset: float = parameter(
        0.0, "m", "added to the scaled ranges, from a calibration: true = scale * measured + offset"
    )
    angle_scale: float = parameter(
        1.0,
        "1",
        "true angle of a beam over that in the messages; `imp inspect` finds it",
        gt=0,
        le=10,
    )
    period: float = parameter(
        0.0,
        "s",
        "scan period, to smooth stamps that jitter; 0: use the stamps as they are",
        ge=0,
        le=60,
    )
    deskew: bool = parameter(True, "", "compensate the robot's motion during the sweep")
    last_beam_first: bool = parameter(
        False,
        "",
        "the last beam of a scan was measured first: for drivers that reverse the beams, not their times",
    )
    sweep_time: float = parameter(
        math.nan,
        "s",
        "time from the first beam of a scan to the last one; nan: that in the messages",
    )
    latency: float = parameter(
        0.0, "s", "delay from the first beam of a scan to its stamp, on the odometry's clock"
    )
    extractors: dict[str, Any] = Field(
        default_factory=dict, description="extractors of landmarks from the scans, by name"
    )

    _clock: SweepClock = PrivateAttr()

    def model_post_init(self, context: Any) -> None:
        """Start the clock."""
        self._clock = SweepClock(self.period)

    @field_validator("range_min", "range_max", "sweep_time")
    @classmethod
    def _is_not_negative(cls, value: float, info: ValidationInfo) -> float:
        if value < 0.0:
            raise ValueError("must be at least 0")
        if info.field_name == "range_max" and value == 0.0:
            raise ValueError("must be above 0; nan: the limit in the messages")
        if info.field_name == "range_max" and value <= info.data.get("range_min", math.nan):
            raise ValueError(f"must be above range_min, {info.data['range_min']:g}")
        return value

    @field_validator("extractors")
    @classmethod
    def _build_extractors(cls, tables: dict[str, Any]) -> dict[str, Extractor]:
        extractors = dict(tables)
        for name, table in tables.items():
            if not isinstance(table, Extractor):
                extractors[name] = build("extractor", table, f"sensors.*.extractors.{name}")
        return extractors

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the times of the first and last beams, (m,) s on the odometry's clock."""
        stamps = self._clock.smooth(plain(columns.stamps)) if self.period else columns.stamps
        begins = stamps - self.latency
        return begins, begins + self._sweep(self._time_offsets(columns))

    def _time_offsets(self, columns: Columns) -> Array:
        """Return the times (n,) of the beams after the first one, s."""
        offsets: Array = columns["time_offsets"]
        if math.isnan(self.sweep_time):
            return offsets
        return np.linspace(0.0, self.sweep_time, len(offsets))

    def _sweep(self, time_offsets: Array) -> float:
        """Return the duration of a sweep, s."""
        return float(time_offsets.max(initial=0.0)) if self.deskew else 0.0

    def _after_middle(self, time_offsets: Array) -> Array:
        """Return the times (n,) of the beams after the middle of a sweep, s."""
        after = time_offsets - 0.5 * self._sweep(time_offsets)
        return -after if self.last_beam_first else after

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which rows have beams: all or none."""
        return np.full(len(columns), len(columns["angles"]) > 0)

    def fault(self, message: Message) -> str:
        """Describe the fault of a scan without beams."""
        return f"the scan at {message.stamp:.3f} s has no beams; it is dropped"

    def sweeps(self, columns: Columns, twists: Array) -> Scans:
        """Return the scans: validated, calibrated, mounted, de-skewed."""
        sent = plain(columns["angles"])
        after = self._after_middle(plain(self._time_offsets(columns)))
        angles = self.angle_scale * (-sent if self.upside_down else sent)
        low, high = self._limits(columns)
        parts = deskew_sweeps(
            plain(columns["ranges"]),
            np.column_stack((angles, after)),
            self.in_field(self.angle_scale * sent),
            twists if self.deskew else np.zeros_like(twists),
            np.array(self.mount),
            RangeCalibration(
                self.range_scale, self.range_offset, low, high, self.sigma, self.sigma_per_m
            ),
        )
        same = self.bias, high, np.array(self.mount), columns["intensities"]
        is_skewed = self.deskew and after.any()
        return Scans(columns.stamps, angles, *parts, *same, after if is_skewed else None)

    def scan(self, message: LaserScan, twist: Array) -> Scan:
        """Return one message as a scan; see `sweeps`."""
        (columns,) = single_row("", message, 0).values()
        return self.sweeps(columns, twist[None]).row(0)

    def _limits(self, columns: Columns) -> tuple[float, float]:
        low, high = range_limits(columns["range_min"], columns["range_max"])
        low, high = float(np.fmax(self.range_min, low)), float(np.fmin(self.range_max, high))
        return (0.0 if math.isnan(low) else low), (math.inf if math.isnan(high) else high)

    def in_field(self, angles: Array) -> Mask:
        """Return (n,) which beams are within the limits of the angle."""
        # Beams of a full turn may be given as 0 to 2 pi: compare directions, not numbers.
        field = self.angle_max - self.angle_min
        turned = np.mod(angles - self.angle_min, 2.0 * np.pi)
        width = np.mod(field, 2.0 * np.pi)
        return np.asarray((field >= 2.0 * np.pi) | (turned <= width))

    def observe(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the extracted landmarks of a scan, with the time at which their beams were fired."""
        scan, offsets = sweeps.scan(k), self._time_offsets(sweeps.columns)
        assert scan is not None
        middle, way = 0.5 * self._sweep(offsets), -1.0 if self.last_beam_first else 1.0
        return tuple(
            o.of_sensor(
                sweeps.sensor,
                way * (float(offsets[o.beams].mean()) - middle) if middle and len(o.beams) else 0.0,
            )
            for extractor in self.extractors.values()
            for o in extractor.observe(scan, rng)
        )
