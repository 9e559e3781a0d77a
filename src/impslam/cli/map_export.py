"""`imp map export`: files of a map for other programs."""

from __future__ import annotations

from pathlib import Path

from impslam.cli import console
from impslam.cli.console import Common, RequiredOutput


def export(
    file: Path,
    /,
    *,
    output: RequiredOutput,
    resolution: float = 0.05,
    common: Common | None = None,
) -> None:
    """Export a map's grid, graph, landmarks and path to files.

    The files are `map.pgm` and `map.yaml` for map_server, `graph.g2o`, `landmarks.csv`,
    `trajectory.tum` and `trajectory.csv` (without health, which a map does not contain).

    Parameters
    ----------
    file
        A map file written by `imp run`.
    output
        A new or empty folder, or one that contains only an earlier export.
    resolution
        Cell size of the grid, m.
    """
    from impslam.cli.map_work import progress_line, result_folder
    from impslam.map import Map
    from impslam.maps.files import map_image
    from impslam.observers.map_files import MAP_FILES, write_map_files
    from impslam.paths import keep_inputs, written

    keep_inputs([file], [output / name for name in MAP_FILES])
    quiet = common is not None and common.quiet
    with progress_line("exporting", quiet):
        known = Map.load(file)
        with result_folder(output, MAP_FILES) as folder, written(output, "give another -o"):
            write_map_files(folder, known, map_image(known.grid(resolution)))
    if not quiet:
        for path in sorted(output.iterdir()):
            console.echo(str(path))
