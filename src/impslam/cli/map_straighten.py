"""`imp map straighten`: align the walls of a map with the axes."""

from __future__ import annotations

import math
from pathlib import Path

from impslam.cli import console
from impslam.cli.console import Common, RequiredOutput


def straighten(
    file: Path,
    /,
    *,
    output: RequiredOutput,
    common: Common | None = None,
) -> None:
    """Rotate a map by up to 45° to align its walls with the axes.

    The graph, path, grid and landmarks are rotated together.

    Parameters
    ----------
    file
        A map file written by `imp run`.
    output
        File of the straightened map.
    """
    from impslam.cli.map_work import check_map_path, progress_line
    from impslam.errors import ImpError
    from impslam.map import Map

    check_map_path(output, [file])
    quiet = common is not None and common.quiet
    with progress_line("straightening", quiet):
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
    spread = f" ± {sigma:.2f}°" if math.isfinite(sigma) else ""
    share = f"{100 * direction.share:.0f} % of the walls are within 5° of the axes"
    console.show_facts({"turned by": f"{turn:+.2f}°{spread}; {share}", "map": str(output)})
