"""`imp map merge`: merge maps."""

from __future__ import annotations

from pathlib import Path

from impslam.cli import console
from impslam.cli.console import Common, RequiredOutput
from impslam.errors import ConfigError, ImpError


def merge(
    *files: Path,
    output: RequiredOutput,
    common: Common | None = None,
) -> None:
    """Merge maps of one building, in the frame of the first.

    Parameters
    ----------
    files
        Two or more map files written by `imp run`.
    output
        File of the merged map.
    """
    from impslam.cli.map_work import check_map_path, progress_line
    from impslam.map import Map
    from impslam.maps.merge import NotMergedError, check_logs, merged

    if len(files) < 2:
        raise ConfigError("merge needs two or more maps: imp map merge A.imp B.imp -o C.imp")
    check_map_path(output, files)
    quiet = common is not None and common.quiet
    maps = [Map.load(file) for file in files]
    check_logs(maps, [str(file) for file in files])
    with progress_line("merging", quiet) as progress:
        try:
            known = merged(*maps, progress=progress.step)
        except NotMergedError as error:
            why = f"{error.found.words}; drive in an area that the other maps contain"
            raise ImpError(f"{files[error.which]}: cannot be merged: {why}") from None
        known.save(output)
    if quiet:
        return
    closures = sum(int((part.edges.kernel < float("inf")).sum()) for part in maps)
    more = int((known.edges.kernel < float("inf")).sum()) - closures
    console.show_facts(
        {
            "merged": f"{len(maps)} maps, joined by {more} closures",
            "scans": str(len(known.stamps)),
            "landmarks": f"{len(known.landmarks)}, merged from {sum(len(one.landmarks) for one in maps)}",
            "map": str(output),
        }
    )
