"""Run all checks on a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from impslam.calibration.recording import first_lidar, record_batches
from impslam.columns import Batch
from impslam.config import Config
from impslam.diagnosis.beams import check_beams
from impslam.diagnosis.direction import check_direction
from impslam.diagnosis.evidence import Evidence, gather_evidence
from impslam.diagnosis.finding import Finding, worst_health
from impslam.diagnosis.handedness import check_handedness
from impslam.diagnosis.head import Head
from impslam.diagnosis.mount import check_mount
from impslam.diagnosis.no_return import check_noise, check_value
from impslam.diagnosis.odometry import check_odometry
from impslam.diagnosis.presets import check_preset
from impslam.diagnosis.scales import check_scales
from impslam.diagnosis.stamps import check_overlap, check_stamps
from impslam.diagnosis.wheels import check_wrap
from impslam.health import Standing
from impslam.sensors.lidar2d import Lidar2D
from impslam.sources.base import Source
from impslam.types import Message

SCANS = 4000
"""Scans at the beginning of a log that are diagnosed: a few minutes of driving, seconds of computing."""
FIRST_SCANS = 600
"""The same before a run: a minute or two of driving, tenths of a second of computing."""

MIN_SCANS = 50
"""Fewer scans do not contain enough motion, and matching them takes longer than such a run."""

ROOT_CHECKS = (check_noise, check_overlap, check_wrap, check_preset)
"""The faults that these find would cause findings of the other checks."""
CHECKS = (
    check_handedness, check_direction, check_stamps, check_odometry, check_scales, check_mount,
    check_value, check_beams,
)  # fmt: skip


def diagnose(
    config: Config,
    batches: Iterable[Batch],
    defaults: Mapping[type[Message], str],
    checks: Sequence[Callable[[Evidence], Iterable[Finding]]] = CHECKS,
) -> list[Finding]:
    """Return the differences between the data of a log and its config, harmful ones first.

    `defaults` are the streams to read if the config names none; see `Source.defaults`.
    """
    if not _has_lidar(config):
        return []
    evidence = gather_evidence(config, record_batches(config, batches, defaults))
    for check in ROOT_CHECKS:
        if roots := list(check(evidence)):
            return roots
    findings = [finding for check in checks for finding in check(evidence)]
    return sorted(findings, key=lambda finding: not finding.harmful)


def first_look(config: Config, source: Source) -> list[Finding]:
    """Return the harmful findings in the beginning of a log; the source must be open."""
    if not _has_lidar(config):
        return []
    head = Head(FIRST_SCANS)
    for _ in head.read(source.batches()):
        pass
    if head.scans < MIN_SCANS:
        return []
    found = diagnose(config, head.batches, source.defaults(), _quick_checks(config))
    return [one for one in found if one.harmful]


def first_health(config: Config, source: Source) -> Standing:
    """Return the worst health that `first_look` implies for all poses of a run; opens its own source."""
    with unread_copy(source) as own:
        return worst_health(first_look(config, own))


def unread_copy(source: Source) -> Source:
    """Return another source of the same log with the same settings, still at its beginning."""
    return type(source)(**{name: getattr(source, name) for name in type(source).model_fields})


def _quick_checks(config: Config) -> Sequence[Callable[[Evidence], Iterable[Finding]]]:
    """Return the checks before a run.

    The order of the beams takes half a second to check. A config that states the duration of a sweep was
    made for the driver that recorded the log.
    """
    _, lidar = first_lidar(config)
    return CHECKS if lidar.period == 0.0 else [c for c in CHECKS if c is not check_direction]


def _has_lidar(config: Config) -> bool:
    return any(isinstance(sensor, Lidar2D) for sensor in config.make_robot().sensors.values())
