"""The JSON output of `imp inspect`: all numbers, and each finding with its settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from impslam.cli.inspect_statistics import ScanGeometry, StampStatistics
from impslam.cli.inspect_survey import Survey
from impslam.cli.output_files import json_text
from impslam.sources.base import Problems, Source, Stream

UNITS = {"temperature": "celsius", "humidity": "share"}


def as_json(
    log: Path,
    source: Source,
    preset: str,
    streams: list[Stream],
    survey: Survey,
    ambient: Mapping[str, tuple[float, float]],
) -> str:
    """Return the facts, problems and findings of a log as JSON; unknown values are null."""
    scans = {name: _beams(beams) for name, beams in sorted(survey.beams.items())}
    facts = {
        "log": str(log),
        "format": source.name,
        "preset": preset,
        "streams": [{**asdict(stream), "used": stream.name in survey.reads} for stream in streams],
        "clocks": {name: _clock(clock) for name, clock in sorted(survey.clocks.items())},
        "scans": next(iter(scans.values()), None),
        "lidars": scans,
        "odometry": {"way_m": survey.distance, "turns_rad": survey.rotation},
        "air": {f"{name}_{unit}": ambient.get(name) for name, unit in UNITS.items()},
        "problems": [
            one for part in (source.problems, survey.unused, survey.problems) for one in _list(part)
        ],
        "findings": [asdict(finding) for finding in survey.findings],
    }
    return json_text(facts)


def _clock(clock: StampStatistics) -> dict[str, Any]:
    return {
        "count": clock.count,
        "rate_hz": clock.rate,
        "first_s": clock.first,
        "last_s": clock.last,
        "longest_gap_s": clock.gap,
        "backward": clock.backward,
        "repeated": clock.repeated,
    }


def _beams(beams: ScanGeometry) -> dict[str, Any]:
    return {
        "beams": sorted(beams.counts),
        "field_of_view_rad": beams.field_of_view,
        "sweep_s": beams.sweep,
        "nearest_m": beams.nearest,
        "farthest_m": beams.farthest,
        "invalid": beams.share_invalid,
    }


def _list(problems: Problems) -> list[dict[str, Any]]:
    return [
        {"kind": kind, "count": count, "example": problems.examples[kind]}
        for kind, count in problems.counts.items()
    ]
