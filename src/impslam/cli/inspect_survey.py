"""Reads a whole log and collects problems and statistics of clocks, scans and motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from impslam.calibration.recording import lidars_of
from impslam.cli.inspect_statistics import MIN_BEAMS, ScanGeometry, StampStatistics
from impslam.columns import Batch, Motions, Sweeps, log_order
from impslam.component import find
from impslam.config import Config
from impslam.diagnosis.diagnose import SCANS, diagnose
from impslam.diagnosis.finding import Finding
from impslam.diagnosis.head import Head
from impslam.odometry.stream import OdometryStream
from impslam.odometry.stream_clocks import UNUSABLE
from impslam.sources.base import Problems, Source
from impslam.types import Array, LaserScan, Message

MAX_POOR_SHARE = 0.5
"""Share of scans with fewer beams, or none, above which a problem is reported."""


class Survey:
    """Reads every message of a log once and keeps only statistics.

    Attributes
    ----------
    clocks : statistics of the stamps by message type, and by stream for each of several lidars
    beams : statistics of the scans by lidar; by "" if the config has none
    distance, rotation : sums of the odometry's motions from scan to scan, m and rad; from reading to
        reading if there are no two scans
    problems, unused : problems with the log as a whole, and with rows that mapping would not use
    findings : where the data contradict the config
    """

    def __init__(self, config: Config) -> None:
        self._config, self._robot = config, config.make_robot()
        self._lidars = lidars_of(self._robot)
        self.unused = self._robot.problems
        self._head = Head(SCANS * max(len(self._lidars), 1))
        self.findings: list[Finding] = []
        self.clocks: dict[str, StampStatistics] = {}
        self.beams: dict[str, ScanGeometry] = {}
        self.distance = self.rotation = 0.0
        self._readings = OdometryStream(self._robot.odometry)
        self._scans, self._by_scans, self._by_readings = 0, np.zeros(2), np.zeros(2)
        self.problems = Problems()

    def read(self, source: Source) -> Iterator[float]:
        """Read an open log; yield the stamps to show progress."""
        for batch in self._robot.streams.read(source):
            self._head.add(batch)
            self._add_motions(self._robot.sense(batch))
            self._add_readings(batch)
            for stream, message in log_order(batch):
                self._add(stream, message)
                yield message.stamp
        self._add_motions(self._robot.flush())
        is_path = self._scans > 1
        self.distance, self.rotation = (self._by_scans if is_path else self._by_readings).tolist()
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

    def _add(self, stream: str, message: Message) -> None:
        if isinstance(message, LaserScan):
            read = (n for n in self._lidars if self._robot.streams.sensors[n].stream == stream)
            name = next(read, "")
            if self._lidars and not name:
                return
            self.beams.setdefault(name, ScanGeometry()).add(message, self._lidars.get(name))
        label = self._label(type(message), stream)
        self.clocks.setdefault(label, StampStatistics()).add(message.stamp)

    def _label(self, kind: type[Message], stream: str) -> str:
        """Return the key of a stream in `clocks`."""
        is_one_of_several = kind is LaserScan and len(self._lidars) > 1
        return f"{kind.__name__} {stream}" if is_one_of_several else kind.__name__

    def _clock(self, name: str) -> StampStatistics | None:
        """Return the statistics of a sensor's stamps; None without messages."""
        kind, stream = self._robot.sensors[name].consumes, self._robot.streams.sensors[name].stream
        return self.clocks.get(self._label(kind, stream))

    def _add_motions(self, sensed: Iterable[tuple[Motions, Sweeps]]) -> None:
        """Add the motions from scan to scan, as in the path of a run; jitter in between is not counted."""
        for motions, _ in sensed:
            self._by_scans += _sums(motions.d_pose[0 if self._scans else 1 :])
            self._scans += len(motions.d_pose)

    def _add_readings(self, batch: Batch) -> None:
        """Add the motions from reading to reading, while there may be no path."""
        rows = batch.get(self._robot.streams.odometry.stream)
        if rows is not None and self._scans < 2:
            self._by_readings += _sums(self._readings.motions(rows).motions.d_pose)

    def _check_log(self, unknown_odometry: str) -> None:
        """Record problems of the log as a whole."""
        needed = self._robot.odometry.consumes.__name__
        motion, sensors = self.clocks.get(needed), self._robot.sensors
        seen = {name: clock for name in sensors if (clock := self._clock(name)) is not None}
        if not seen:
            self.problems.add(
                "no scan",
                f"the log contains no {self._scan_types()} for mapping: record it, or name its topic with "
                "--topic scan=NAME",
            )
        if motion is None:
            self.problems.add("no odometry", self._no_odometry(needed, unknown_odometry))
        for name, clock in seen.items():
            if motion is not None:
                self._check_clocks(name, clock, motion)
        for name in filter(None, self.beams):
            self._check_beams(name, self.beams[name])

    def _check_beams(self, name: str, beams: ScanGeometry) -> None:
        poor = beams.poor  # the robot reports those without any
        if poor and poor + beams.blind > MAX_POOR_SHARE * beams.scans:
            self.problems.add(
                "few valid beams",
                f"{poor} of {beams.scans} scans have some, but fewer than {MIN_BEAMS} valid ranges: "
                f"check the lidar, or sensors.{name}.range_min and range_max",
            )

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

    def _check_clocks(self, name: str, scans: StampStatistics, motion: StampStatistics) -> None:
        is_diagnosed = name in lidars_of(self._robot)  # by `diagnose`
        if is_diagnosed or UNUSABLE in self.unused.counts:
            return
        latency = getattr(self._robot.sensors[name], "latency", 0.0)
        if scans.last - latency < motion.first or scans.first - latency > motion.last:
            self.problems.add(
                "clocks differ",
                f"scans are stamped {scans.first:.3f} to {scans.last:.3f} s, odometry "
                f"{motion.first:.3f} to {motion.last:.3f} s: align them with "
                f"--set sensors.{name}.latency={scans.first - motion.first:.3f}",
            )


def _sums(steps: Array) -> Array:
    """Return the sums (2,) m, rad of the distances and turns of steps (m, 3) that are not NaN."""
    distances, turns = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    return np.array([np.nansum(distances), np.nansum(turns)])
