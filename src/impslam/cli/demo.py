"""`imp demo`: the arena of the thesis simulated, mapped, and scored against the truth."""

from __future__ import annotations

from impslam.cli.console import Base, Common, Force, Output, Settings


def demo(
    *,
    seed: int = 0,
    output: Output = None,
    config: Base = None,
    settings: Settings = (),
    force: Force = False,
    common: Common | None = None,
) -> None:
    """Simulate the arena of the thesis, map it, and print the map beside the truth.

    Parameters
    ----------
    seed
        Seed of all noise.
    output
        A new folder to write to. Default: runs/arena-DATE-TIME.
    """
    from impslam.cli.arena import map_arena

    map_arena(
        seed, output, config, settings, force=force, quiet=common is not None and common.quiet
    )
