"""What `imp run` prints first: the preset and streams in use, and problems in the first minutes."""

from __future__ import annotations

from impslam.cli import console
from impslam.config import Config
from impslam.config_from_log import choices
from impslam.diagnosis.diagnose import initial_findings, unread_copy
from impslam.diagnosis.finding import worst_fault
from impslam.health import LogFault
from impslam.sources.base import Source


def show_initial_findings(config: Config, source: Source, preset: str | None) -> LogFault:
    """Print preset, streams, mounts and problems of a log; return the fault that affects all poses.

    `preset` is the one given by the user, if any.
    """
    with unread_copy(source) as log:
        found = log.preset
        harm = initial_findings(config, log)
        chosen = choices(config, log)
    named = preset or ("stored in the log" if "\n" in found else found)
    console.echo(f"reads: preset {named}; {chosen}")
    for finding in harm:
        console.show_finding(finding.kind, str(finding), harmful=True)
    return worst_fault(harm)
