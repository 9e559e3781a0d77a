"""`imp config`: every parameter of a run with its value."""

from __future__ import annotations

from impslam.cli import console
from impslam.cli.console import Common, Settings


def config(
    preset: str = "default", /, *, settings: Settings = (), common: Common | None = None
) -> None:
    """Print a preset or TOML file with every parameter in it; what is printed loads again.

    Parameters
    ----------
    preset
        Name of a preset, or a TOML file.
    """
    import tomli_w

    from impslam.config import load

    del common
    console.say(tomli_w.dumps(load(preset, settings).resolved()).rstrip())
