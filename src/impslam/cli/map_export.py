"""`imp map export`: a map as files for other programs."""

from __future__ import annotations

from pathlib import Path

from impslam.cli import console
from impslam.cli.console import Common, Target


def export(
    file: Path,
    /,
    *,
    output: Target,
    resolution: float = 0.05,
    common: Common | None = None,
) -> None:
    """Write a map's grid, graph, landmarks and path as files.

    `map.pgm` and `map.yaml` for map_server, `graph.g2o`, `landmarks.csv`, `trajectory.tum` and
    `trajectory.csv`.

    Parameters
    ----------
    file
        A map, as `imp run` writes it.
    output
        A new or an empty folder, or one that holds nothing but an export.
    resolution
        Side of a cell of the grid, m.
    """
    from impslam.cli.map_work import result_folder, working
    from impslam.map import Map
    from impslam.maps.files import map_image
    from impslam.observers.map_files import MAP_FILES, write_map_files
    from impslam.paths import written

    quiet = common is not None and common.quiet
    with working("exporting", quiet):
        known = Map.load(file)
        image = map_image(known.grid(resolution))
        result_folder(output, MAP_FILES)
        with written(output, "give another -o"):
            write_map_files(output, known, image)
    if not quiet:
        for path in sorted(output.iterdir()):
            console.say(str(path))
