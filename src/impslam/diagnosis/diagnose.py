"""All checks of a log, one after another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from impslam.calibration.recording import record_batches
from impslam.columns import Batch
from impslam.config import Config
from impslam.diagnosis.beams import beams
from impslam.diagnosis.evidence import evidence
from impslam.diagnosis.finding import Finding, standing
from impslam.diagnosis.handedness import handedness
from impslam.diagnosis.head import Head
from impslam.diagnosis.mount import mount
from impslam.diagnosis.odometry import odometry
from impslam.diagnosis.presets import preset
from impslam.diagnosis.scales import scales
from impslam.diagnosis.stamps import overlap, stamps
from impslam.diagnosis.wheels import wheels
from impslam.health import Standing
from impslam.sensors.lidar2d import Lidar2D
from impslam.sources.base import Source
from impslam.types import Message

SCANS = 4000
"""Scans at the beginning of a log that are diagnosed: some minutes, and seconds of work."""
FIRST_SCANS = 600
"""The same before a run: a minute or two, and tenths of a second."""

LEAST_SCANS = 50
"""Fewer scans do not show enough motion to tell anything; following them takes longer than such a run."""

ROOTS = (overlap, wheels, preset)
"""What these find makes others find much that follows from it."""
CHECKS = (handedness, stamps, odometry, scales, mount, beams)


def diagnose(
    config: Config, batches: Iterable[Batch], defaults: Mapping[type[Message], str]
) -> list[Finding]:
    """Return what the batches of a log show to be other than its config says, what harms first.

    `defaults` are the streams to read where the config names none; see `Source.defaults`.
    """
    if not _has_lidar(config):
        return []
    known = evidence(config, record_batches(config, batches, defaults))
    for check in ROOTS:
        if roots := list(check(known)):
            return roots
    found = [finding for check in CHECKS for finding in check(known)]
    return sorted(found, key=lambda finding: not finding.harmful)


def first_look(config: Config, source: Source) -> list[Finding]:
    """Return what harms a run, as far as the beginning of a log shows it; the source must be open."""
    if not _has_lidar(config):
        return []
    head = Head(FIRST_SCANS)
    for _ in head.read(source.batches()):
        pass
    if head.scans < LEAST_SCANS:
        return []
    return [one for one in diagnose(config, head.batches, source.defaults()) if one.harmful]


def first_health(config: Config, source: Source) -> Standing:
    """Return what `first_look` says of all poses of a run; the source is opened anew."""
    with fresh(source) as own:
        return standing(first_look(config, own))


def fresh(source: Source) -> Source:
    """Return another source of the same log, with the same settings, that nobody has read yet."""
    return type(source)(**{name: getattr(source, name) for name in type(source).model_fields})


def _has_lidar(config: Config) -> bool:
    return any(isinstance(sensor, Lidar2D) for sensor in config.make_robot().sensors.values())
