"""`imp inspect`: print the contents of a log and its problems."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from impslam.cli import console
from impslam.cli.console import Columns, Common, ConfigName, Flag, Settings, Topics
from impslam.cli.progress import display, with_progress

if TYPE_CHECKING:
    from impslam.cli.inspect_statistics import ScanGeometry
    from impslam.cli.inspect_survey import Survey
    from impslam.config import Config
    from impslam.diagnosis.finding import Finding
    from impslam.sources.base import Problems, Stream


def inspect(
    log: Path,
    /,
    *,
    config: ConfigName = None,
    settings: Settings = (),
    topics: Topics = (),
    columns: Columns = (),
    json: Flag = False,
    common: Common | None = None,
) -> None:
    """Print the contents of a log, how they are used, and problems with their fixes.

    Parameters
    ----------
    log
        A file or folder; its format is detected from its content.
    json
        Print everything as JSON.
    """
    from impslam.cli.inspect_survey import Survey
    from impslam.cli.job import all_settings
    from impslam.config_from_log import choices
    from impslam.open_log import open_log

    chosen, source = open_log(log, config, all_settings(settings, topics, columns))
    survey = Survey(chosen)
    with source, display(common is not None and common.quiet) as progress:
        streams, preset, ambient = source.streams(), source.preset, source.surroundings()
        for _ in with_progress(survey.read(source), source, progress, "reading"):
            pass
    named = config or ("stored in the log" if "\n" in preset else preset)
    if json:
        from impslam.cli.inspect_json import as_json

        console.echo(as_json(source.path, source, named, streams, survey, ambient))
        return
    console.echo(f"{source.path}: {source.name}, preset {named}")
    _show_streams(streams, survey.reads)
    console.echo(f"reads: {choices(chosen, source)}")
    _show_clocks(survey)
    facts = _facts_of_lidars(survey) | _motion_facts(survey, chosen) | _ambient_facts(ambient)
    console.show_facts(facts)
    _show_problems(source.problems, survey.unused, survey.problems, findings=survey.findings)


def _show_streams(streams: list[Stream], reads: frozenset[str]) -> None:
    rows = [
        (
            s.name,
            s.type,
            "yes" if s.name in reads else "no",
            s.note,
            "" if s.count is None else str(s.count),
        )
        for s in streams
    ]
    console.show_table(("stream", "type", "used", "as", "messages"), rows, numbers=1)


def _show_clocks(survey: Survey) -> None:
    rows = [
        (
            name,
            str(clock.count),
            _number(clock.rate, 1),
            _number(clock.duration, 1),
            _number(clock.gap, 3),
            str(clock.backward),
            str(clock.repeated),
        )
        for name, clock in sorted(survey.clocks.items())
    ]
    header = ("message", "count", "Hz", "seconds", "longest gap, s", "backward", "repeated")
    console.show_table(header, rows, numbers=6)
    if any(clock.backward for clock in survey.clocks.values()):
        console.echo(
            "backward stamps alone are not a problem: messages are used in the order of the log"
        )


def _facts_of_lidars(survey: Survey) -> dict[str, str]:
    """Return the facts on the scans, with the name of their lidar if there are several."""
    if len(survey.beams) < 2:
        return next((_scan_facts(beams) for beams in survey.beams.values()), {"scans": "none"})
    return {
        f"{name}: {fact}": value
        for name, beams in sorted(survey.beams.items())
        for fact, value in _scan_facts(beams).items()
    }


def _scan_facts(beams: ScanGeometry) -> dict[str, str]:
    counts = sorted(beams.counts)
    several = f" to {counts[-1]}" if len(counts) > 1 else ""
    turns = f", {len(beams.starts)} start angles" if len(beams.starts) > 1 else ""
    sweep = f"{1000 * beams.sweep:.0f} ms" if beams.sweep else "not in the log; assumed to be 0"
    return {
        "beams": f"{counts[0]}{several}",
        "field of view": f"{math.degrees(beams.field_of_view):.1f} deg{turns}",
        "sweep": sweep,
        "range limits": _range_limits(beams),
        "valid ranges": f"{beams.nearest:.2f} to {beams.farthest:.2f} m"
        if beams.farthest
        else "none",
        "invalid beams": f"{100 * beams.share_invalid:.1f} %",
    }


def _range_limits(beams: ScanGeometry) -> str:
    """Return the limits that decide which beams are valid: the narrower of messages and config."""
    ends = []
    for narrower, in_messages, given in zip((max, min), beams.limits, beams.given, strict=True):
        known = [value for value in (in_messages, given) if not math.isnan(value)]
        end = narrower(known, default=math.nan)
        origin = "messages" if end == in_messages else "config"
        ends.append(f"{end:.2f} m ({origin})" if known else "")
    low, high = ends
    if low and high:
        return f"{low} to {high}"
    return (low and f"from {low}") or (high and f"up to {high}") or "none"


def _motion_facts(survey: Survey, config: Config) -> dict[str, str]:
    if not survey.has_odometry:
        return {"odometry": "none"}
    distance = f"{survey.distance:.2f} m"
    turns = f"{math.degrees(survey.rotation):.0f} deg of turns"
    return {"odometry": f"{config.odometry['kind']}, {distance}, {turns}"}


def _ambient_facts(ambient: Mapping[str, tuple[float, float]]) -> dict[str, str]:
    units = {"temperature": (1.0, "deg C"), "humidity": (100.0, "%")}
    return {
        name: f"{units[name][0] * low:.1f} to {units[name][0] * high:.1f} {units[name][1]}"
        for name, (low, high) in ambient.items()
    }


def _show_problems(*all_problems: Problems, findings: list[Finding]) -> None:
    console.echo("")
    for problems in all_problems:
        for kind, count in problems.counts.items():
            console.show_problem(kind, count, problems.examples[kind])
    for finding in findings:
        console.show_finding(finding.kind, str(finding), harmful=finding.harmful)
    kinds = {kind for problems in all_problems for kind in problems.counts}
    if kinds <= console.HARMLESS and not any(finding.harmful for finding in findings):
        console.echo("no problems found")


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
