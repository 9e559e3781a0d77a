"""Run all checks on a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeAlias

from impslam.calibration.recording import lidars_of, record_batches
from impslam.columns import Batch
from impslam.config import Config
from impslam.diagnosis.beams import check_beams
from impslam.diagnosis.evidence import Evidence, confirmed, gather_evidence
from impslam.diagnosis.field_of_view import check_field_of_view
from impslam.diagnosis.finding import Finding, worst_fault
from impslam.diagnosis.handedness import check_handedness
from impslam.diagnosis.head import Head
from impslam.diagnosis.motion import check_motion
from impslam.diagnosis.mount import check_mount
from impslam.diagnosis.no_return import check_noise, check_value
from impslam.diagnosis.odometry import check_odometry
from impslam.diagnosis.presets import check_preset
from impslam.diagnosis.range_offset import check_range_offset
from impslam.diagnosis.scales import check_scales
from impslam.diagnosis.stamps import check_clocks, check_repeats, check_stamps
from impslam.diagnosis.sweep import check_overlap, check_times, is_instant
from impslam.diagnosis.units import check_pose_units, check_range_unit
from impslam.diagnosis.wheels import check_wrap
from impslam.health import LogFault
from impslam.sources.base import Source
from impslam.types import Message

Check: TypeAlias = Callable[[Evidence], Iterable[Finding]]

SCANS = 4000
"""Scans of each lidar that are diagnosed: a few minutes of driving, seconds of computing."""
FIRST_SCANS = 600
"""The same before a run: a minute or two of driving, tenths of a second of computing."""

MIN_SCANS = 50
"""Fewer scans do not contain enough motion, and matching them takes longer than such a run."""

LIDAR_ROOTS = (
    check_range_unit, check_noise, check_overlap, check_field_of_view, check_range_offset, check_repeats,
    check_clocks,
)  # fmt: skip
ODOMETRY_ROOTS = (check_wrap, check_pose_units, check_preset)
"""The faults of a lidar, and of odometry, that these find would cause findings of the other checks."""
SLOW = (check_field_of_view, check_range_offset)
"""Checks that match pairs of scans again; a quick diagnosis leaves them out."""
CHECKS = (
    check_handedness, check_times, check_odometry, check_scales, check_mount,
    check_value, check_beams,
)  # fmt: skip


def diagnose(
    config: Config,
    batches: Iterable[Batch],
    defaults: Mapping[type[Message], str],
    *,
    is_quick: bool = False,
) -> list[Finding]:
    """Return the differences between the data of a log and its config, harmful ones first.

    `defaults` are the streams to read if the config names none; see `Source.defaults`. Each lidar is
    compared with odometry; a quick diagnosis leaves out the slowest checks where they are hardly needed.
    """
    names = list(lidars_of(config.make_robot()))
    if len(names) > 1:
        batches = list(batches)  # which are read several times
    every = confirmed(
        [
            gather_evidence(config, name, record_batches(config, batches, defaults, name))
            for name in names
        ]
    )
    findings = _check_all(every, is_quick)
    if len(every) > 1:
        findings = [finding.with_lidar() for finding in findings]
    return sorted(findings, key=lambda finding: not finding.harmful)


def _check_all(every: Sequence[Evidence], is_quick: bool) -> list[Finding]:
    """Return the findings about each lidar, and those about odometry by one of them."""
    findings, sound = list[Finding](), list[Evidence]()
    checks = [check for check in LIDAR_ROOTS if not (is_quick and check in SLOW)]
    for e in every:
        roots = _first_roots(checks, e)
        findings += roots
        sound += [] if roots else [e]
    if not sound:
        return findings
    findings += [finding for e in sound for finding in check_motion(e)]
    reference = next((e for e in sound if e.agreement is not None), sound[0])
    if roots := _first_roots(ODOMETRY_ROOTS, reference):
        return findings + roots
    for e in sound:
        found = [finding for check in _checks(e, is_quick) for finding in check(e)]
        findings += [finding for finding in found if finding.lidar or e is reference]
    return findings


def _first_roots(checks: Sequence[Check], e: Evidence) -> list[Finding]:
    """Return the findings of the first check that has any."""
    return next((roots for check in checks if (roots := list(check(e)))), [])


def _checks(e: Evidence, is_quick: bool) -> Sequence[Check]:
    """Return the checks of a lidar; the times of its beams take tenths of a second to check.

    A config that states the duration of a sweep was made for the driver that recorded the log. Many logs
    have no such times, which only does harm if a sweep may take long.
    """
    is_known = is_quick and (e.lidar.period != 0.0 or is_instant(e))
    if not is_known:
        return CHECKS
    return [check_stamps if check is check_times else check for check in CHECKS]


def initial_findings(config: Config, source: Source) -> list[Finding]:
    """Return the harmful findings in the beginning of a log; the source must be open."""
    lidars = len(lidars_of(config.make_robot()))
    if not lidars:
        return []
    head = Head(FIRST_SCANS * lidars)
    for _ in head.read(source.batches()):
        pass
    if head.scans < MIN_SCANS * lidars:
        return []
    found = diagnose(config, head.batches, source.defaults(), is_quick=True)
    return [one for one in found if one.harmful]


def find_log_fault(config: Config, source: Source) -> LogFault:
    """Return the worst fault that affects all poses, by the initial findings; opens its own source."""
    with unread_copy(source) as own:
        return worst_fault(initial_findings(config, own))


def unread_copy(source: Source) -> Source:
    """Return another source of the same log with the same settings, still at its beginning."""
    return type(source)(**{name: getattr(source, name) for name in type(source).model_fields})
