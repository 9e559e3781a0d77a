"""`imp demo`: simulate the arena of the thesis, map it, and score the map against the truth."""

from __future__ import annotations

from impslam.cli.console import Common, ConfigName, Force, Output, Settings, SimulationSeed
from impslam.cli.interruption import Interruption


def demo(
    *,
    seed: SimulationSeed = 0,
    output: Output = None,
    config: ConfigName = None,
    settings: Settings = (),
    force: Force = False,
    common: Common | None = None,
) -> None:
    """Simulate a drive through a small arena, map it, and score the map.

    Parameters
    ----------
    seed
        Random seed.
    output
        New folder for the results. Default: runs/arena-DATE-TIME.
    """
    with Interruption() as interruption:
        from impslam.cli.demo_arena import map_arena

        quiet = common is not None and common.quiet
        map_arena(
            seed, output, config, settings, force=force, quiet=quiet, interruption=interruption
        )
