"""`imp map straighten`: walls along the axes."""

from __future__ import annotations

import math
from pathlib import Path

from impslam.cli import console
from impslam.cli.console import Common, Target


def straighten(
    file: Path,
    /,
    *,
    output: Target,
    common: Common | None = None,
) -> None:
    """Turn a map, by 45° at most, so that its walls are along the axes.

    Graph, path, grid and landmarks turn with it.

    Parameters
    ----------
    file
        A map, as `imp run` writes it.
    output
        The straightened map.
    """
    from impslam.cli.map_work import working
    from impslam.errors import ImpError
    from impslam.map import Map

    quiet = common is not None and common.quiet
    with working("straightening", quiet):
        known = Map.load(file)
        direction = known.direction()
        try:
            straight = known.straightened()
        except ImpError as error:
            raise ImpError(f"{file}: {error}") from None
        straight.save(output)
    if quiet:
        return
    turn, sigma = math.degrees(-direction.angle), math.degrees(direction.sigma)
    sure = f" ± {sigma:.2f}°" if math.isfinite(sigma) else ""
    share = f"{100 * direction.share:.0f} % of the walls are within 5° of the axes"
    console.show_facts({"turned by": f"{turn:+.2f}°{sure}; {share}", "map": str(output)})
