"""What `imp run` says before it begins: what it has chosen, and what the first minutes show to be wrong."""

from __future__ import annotations

from impslam.cli import console
from impslam.config import Config
from impslam.diagnosis.diagnose import first_look
from impslam.fitting import choices
from impslam.sources.base import Source


def show_first_look(config: Config, source: Source, preset: str | None) -> None:
    """Print which preset, streams and mounts a run uses, and what harms it.

    `preset` is the one that was asked for.
    """
    own = type(source)(**{name: getattr(source, name) for name in type(source).model_fields})
    with own as log:
        found = log.preset
        harm = first_look(config, log)
        chosen = choices(config, log)
    named = preset or ("stored in the log" if "\n" in found else found)
    console.say(f"reads: preset {named}; {chosen}")
    for finding in harm:
        console.show_finding(finding.kind, str(finding), harmful=True)
