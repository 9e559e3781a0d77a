"""What `imp run` says before it begins: what it has chosen, and what the first minutes show to be wrong."""

from __future__ import annotations

from impslam.cli import console
from impslam.config import Config
from impslam.diagnosis.diagnose import first_look, unread_copy
from impslam.diagnosis.finding import worst_health
from impslam.fitting import choices
from impslam.health import Standing
from impslam.sources.base import Source


def show_first_look(config: Config, source: Source, preset: str | None) -> Standing:
    """Print which preset, streams and mounts a run uses, and what harms it.

    `preset` is the one that was asked for. Returned is what that says of all poses of the run.
    """
    with unread_copy(source) as log:
        found = log.preset
        harm = first_look(config, log)
        chosen = choices(config, log)
    named = preset or ("stored in the log" if "\n" in found else found)
    console.say(f"reads: preset {named}; {chosen}")
    for finding in harm:
        console.show_finding(finding.kind, str(finding), harmful=True)
    return worst_health(harm)
