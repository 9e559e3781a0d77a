"""All checks of a log, one after another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from impslam.calibration.recording import record_batches
from impslam.columns import Batch
from impslam.config import Config
from impslam.diagnosis.evidence import evidence
from impslam.diagnosis.finding import Finding
from impslam.diagnosis.handedness import handedness
from impslam.diagnosis.mount import mount
from impslam.diagnosis.odometry import odometry
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Message

CHECKS = (handedness, mount, odometry)


def diagnose(
    config: Config, batches: Iterable[Batch], defaults: Mapping[type[Message], str]
) -> list[Finding]:
    """Return what the batches of a log show to be other than its config says, what harms first.

    `defaults` are the streams to read where the config names none; see `Source.defaults`.
    """
    if not any(isinstance(sensor, Lidar2D) for sensor in config.make_robot().sensors.values()):
        return []
    known = evidence(config, record_batches(config, batches, defaults))
    found = [finding for check in CHECKS for finding in check(known)]
    return sorted(found, key=lambda finding: not finding.harmful)
