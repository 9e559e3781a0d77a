"""Reads a whole log and collects problems and statistics of clocks, scans and motion."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from impslam.columns import Motions, Sweeps, messages
from impslam.component import find
from impslam.config import Config
from impslam.diagnosis.diagnose import SCANS, diagnose, head_of
from impslam.diagnosis.finding import Finding
from impslam.odometry.stream_clocks import UNUSABLE
from impslam.sensors.lidar2d import Lidar2D
from impslam.sources.base import Problems, Source
from impslam.types import Array, LaserScan, Message

MIN_BEAMS = 10
"""Number of valid beams that a scan needs to be matched."""
FULL_TURN_STEPS = 1.5
"""Steps from the last beam to the first of a full turn: one, in theory; drivers round the step."""
MAX_POOR_SHARE = 0.5
"""Share of scans with fewer beams, or none, above which a problem is reported."""


@dataclass(slots=True)
class StampStatistics:
    """Statistics of the stamps of one message type."""

    count: int = 0
    first: float = math.nan
    last: float = math.nan
    backward: int = 0
    repeated: int = 0
    gap: float = 0.0
    _previous: float = math.nan

    def add(self, stamp: float) -> None:
        """Add a stamp."""
        step = stamp - self._previous
        self.backward += step < 0.0
        self.repeated += step == 0.0
        self.gap = max(self.gap, step)  # unchanged if step is NaN
        self.first, self.last = min(stamp, self.first), max(stamp, self.last)
        if self.count == 0:
            self.first = self.last = stamp
        self.count, self._previous = self.count + 1, stamp

    @property
    def duration(self) -> float:
        """Time from the first to the last stamp, s."""
        return self.last - self.first

    @property
    def rate(self) -> float:
        """Messages per second; NaN for a single message."""
        return (self.count - 1) / self.duration if self.duration > 0.0 else math.nan


@dataclass(slots=True)
class ScanGeometry:
    """The geometry of the scans; `poor` ones have few valid beams, `blind` ones none."""

    counts: dict[int, int] = field(default_factory=dict)
    starts: set[float] = field(default_factory=set)
    field_of_view: float = 0.0
    limits: tuple[float, float] = (math.nan, math.nan)
    nearest: float = math.inf
    farthest: float = 0.0
    sweeps: list[float] = field(default_factory=list)
    total: int = 0
    invalid: int = 0
    scans: int = 0
    poor: int = 0
    blind: int = 0

    def add(self, scan: LaserScan, lidar: Lidar2D | None) -> None:
        """Add a scan; the lidar of the config, if any, decides which beams are valid."""
        n = len(scan.ranges)
        self.counts[n] = self.counts.get(n, 0) + 1
        self.limits = scan.range_min, scan.range_max
        if n == 0:
            return
        self.starts.add(round(float(scan.angles[0]), 4))
        self.field_of_view = _field_of_view(scan.angles)
        self.sweeps.append(float(scan.time_offsets.max()))
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(scan.ranges) & (scan.ranges > 0.0)
        if lidar is not None:
            valid = lidar.scan(scan, np.zeros(3)).valid
        count = int(valid.sum())
        self.total, self.invalid = self.total + n, self.invalid + n - count
        self.scans, self.poor = self.scans + 1, self.poor + (0 < count < MIN_BEAMS)
        self.blind += count == 0
        if valid.any():
            self.nearest = min(self.nearest, float(scan.ranges[valid].min()))
            self.farthest = max(self.farthest, float(scan.ranges[valid].max()))

    @property
    def sweep(self) -> float:
        """Median duration of a sweep, s: drivers that measure it double it when they lose a scan."""
        return statistics.median(self.sweeps) if self.sweeps else 0.0

    @property
    def share_invalid(self) -> float:
        """Share of invalid beams."""
        return self.invalid / self.total if self.total else 0.0


def _field_of_view(angles: Array) -> float:
    """Return the angle between the first and the last beam, or 2 pi if they are neighbours, rad."""
    span, full = float(np.ptp(angles)), 2.0 * math.pi
    step = span / max(len(angles) - 1, 1)
    return full if span + FULL_TURN_STEPS * step >= full else span


class Survey:
    """Reads every message of a log once and keeps only statistics.

    Attributes
    ----------
    clocks, beams : statistics of the stamps by message type, and of the scans
    distance, rotation : sums of the odometry's motions from scan to scan, m and rad
    problems, unused : problems with the log as a whole, and with rows that mapping would not use
    findings : where the data contradict the config
    """

    def __init__(self, config: Config) -> None:
        self._config, self._robot = config, config.make_robot()
        self.unused, self._head = self._robot.problems, head_of(config, SCANS)
        self.findings: list[Finding] = []
        self.clocks: dict[str, StampStatistics] = {}
        self.beams = ScanGeometry()
        self.distance = self.rotation = 0.0
        self._scans, self._before = 0, list[Array]()  # the motion before the first scan
        self.problems = Problems()

    def read(self, source: Source) -> Iterator[float]:
        """Read an open log; yield the stamps to show progress."""
        self._robot.streams.choose(source.defaults())
        for batch in source.batches():
            self._head.add(batch)
            self._add_motions(self._robot.sense(batch))
            for message in messages([batch]):
                self._add(message)
                yield message.stamp
        self._add_motions(self._robot.flush())
        if self._scans < 2:  # no path: all motion
            self._add_steps(np.vstack((*self._before, self._robot.ahead().d_pose)))
        self._check_log(source.unknown_odometry())
        self.findings = diagnose(self._config, self._head.batches, source.defaults())

    @property
    def has_odometry(self) -> bool:
        """Whether the log contains readings of the config's odometry, and these measure motion."""
        odometry = self._robot.odometry
        return odometry.measures_motion and odometry.consumes.__name__ in self.clocks

    @property
    def reads(self) -> frozenset[str]:
        """Names of the streams that mapping reads."""
        return self._robot.streams.named

    def _add(self, message: Message) -> None:
        self.clocks.setdefault(type(message).__name__, StampStatistics()).add(message.stamp)
        if isinstance(message, LaserScan):
            lidars = (s for s in self._robot.sensors.values() if isinstance(s, Lidar2D))
            self.beams.add(message, next(lidars, None))

    def _add_motions(self, sensed: Iterable[tuple[Motions, Sweeps]]) -> None:
        """Add the motions from scan to scan, as in the path of a run; jitter in between is not counted."""
        for motions, _ in sensed:
            steps = motions.d_pose
            if not self._scans:
                self._before, steps = [steps[:1]], steps[1:]
            self._scans += len(motions.d_pose)
            self._add_steps(steps)

    def _add_steps(self, steps: Array) -> None:
        self.distance += float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        self.rotation += float(np.abs(steps[:, 2]).sum())

    def _check_log(self, unknown_odometry: str) -> None:
        """Record problems of the log as a whole."""
        needed = self._robot.odometry.consumes.__name__
        name, motion = self._sensor_name(), self.clocks.get(needed)
        if name is None:
            self.problems.add(
                "no scan",
                f"the log contains no {self._scan_types()} for mapping: record it, or name its topic with "
                "--topic scan=NAME",
            )
        if motion is None:
            self.problems.add("no odometry", self._no_odometry(needed, unknown_odometry))
        if name is not None and motion is not None:
            self._check_clocks(name, motion)
        poor, blind = self.beams.poor, self.beams.blind  # the robot reports blind ones
        if poor and poor + blind > MAX_POOR_SHARE * self.beams.scans:
            self.problems.add(
                "few valid beams",
                f"{poor} of {self.beams.scans} scans have some, but fewer than {MIN_BEAMS} valid ranges: "
                f"check the lidar, or sensors.{name}.range_min and range_max",
            )

    def _sensor_name(self) -> str | None:
        """Return the name of the robot's first sensor with messages in the log."""
        sensors = self._robot.sensors.items()
        return next((n for n, s in sensors if s.consumes.__name__ in self.clocks), None)

    def _scan_types(self) -> str:
        return " or ".join(sensor.consumes.__name__ for sensor in self._robot.sensors.values())

    def _no_odometry(self, needed: str, unknown: str) -> str:
        kind = self._robot.odometry.name
        others = {"OdometryPose": "odometry_pose", "WheelAngles": "encoders"}
        fix = next((k for name, k in others.items() if name in self.clocks), None)
        advice = self._settings(fix) if fix else unknown or "record wheel angles or odometry"
        return f"odometry {kind!r} needs {needed}, but the log contains none: {advice}"

    def _settings(self, kind: str) -> str:
        """Return the advice to use a kind of odometry, with all parameters that it requires."""
        fields = find("odometry", kind).model_fields.items()
        needed = [n for n, one in fields if one.is_required() and n not in self._config.odometry]
        return f"use --set odometry.kind={kind}" + "".join(
            f" --set odometry.{name}={name.upper()}" for name in needed
        )

    def _check_clocks(self, name: str, motion: StampStatistics) -> None:
        sensor = self._robot.sensors[name]
        if UNUSABLE in self.unused.counts:
            return
        scans, latency = self.clocks[sensor.consumes.__name__], getattr(sensor, "latency", 0.0)
        if scans.last - latency < motion.first or scans.first - latency > motion.last:
            self.problems.add(
                "clocks apart",
                f"scans are stamped {scans.first:.3f} to {scans.last:.3f} s, odometry "
                f"{motion.first:.3f} to {motion.last:.3f} s: align them with "
                f"--set sensors.{name}.latency={scans.first - motion.first:.3f}",
            )
