"""`imp demo`: the arena of the thesis simulated, mapped, and scored against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from impslam.cli.console import Base, Common, Settings


def demo(
    *,
    seed: int = 0,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    config: Base = None,
    settings: Settings = (),
    common: Common | None = None,
) -> None:
    """Simulate the arena of the thesis, map it, and print the map beside the truth.

    Parameters
    ----------
    seed
        Seed of all noise.
    output
        The folder to write to. Default: runs/arena-DATE-TIME.
    """
    from impslam.cli.arena import map_arena

    map_arena(seed, output, config, settings, quiet=common is not None and common.quiet)
