"""`imp map diff`: the changes between two maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from impslam.cli import console
from impslam.cli.console import Common, Flag, Output

if TYPE_CHECKING:
    from impslam.maps.changes import Change, Changes


def diff(
    before: Path,
    after: Path,
    /,
    *,
    aligned: Flag = False,
    output: Output = None,
    json: Path | None = None,
    common: Common | None = None,
) -> None:
    """Show the changes between two maps of a place.

    Parameters
    ----------
    before
        The earlier map. Positions are printed in its frame.
    after
        The later map.
    aligned
        The maps already share a frame. Default: align the later map with the earlier one.
    output
        PNG file to draw the changes to.
    json
        JSON file to write all numbers to.
    """
    from impslam.cli.map_work import progress_line
    from impslam.cli.output_files import check_png, write_json
    from impslam.errors import ImpError
    from impslam.map import Map
    from impslam.maps.changes import changes
    from impslam.maps.files import map_image
    from impslam.maps.relation import aligned_to
    from impslam.observers.change_picture import changes_png
    from impslam.paths import keep_inputs, write_bytes

    quiet = common is not None and common.quiet
    if output is not None:
        check_png(output)
    keep_inputs([before, after], [output, json])
    known, other = Map.load(before), Map.load(after)
    with progress_line("aligning the maps", quiet) as progress:
        if not aligned:
            try:
                other = aligned_to(known, other, progress)
            except ImpError as error:
                raise ImpError(f"{after} in {before}: {error}") from None
    with progress_line("comparing", quiet):
        found = changes(known, other)
        if output is not None:
            write_bytes(output, changes_png(map_image(other.grid()), found))
    if not quiet:
        _show(found)
    if json is not None:
        write_json(json, {"gone": _facts(found.gone), "new": _facts(found.new)})


def _show(found: Changes) -> None:
    named = [("gone", c) for c in found.gone] + [("new", c) for c in found.new]
    rows = [
        (str(n), what, f"{c.position[0]:.2f}", f"{c.position[1]:.2f}", f"{c.length:.2f}")
        for n, (what, c) in enumerate(named, 1)
    ]
    if not rows:
        console.echo("nothing has changed in the area that both maps cover")
        return
    console.show_table(("", "what", "x, m", "y, m", "length, m"), rows, numbers=3)


def _facts(pieces: tuple[Change, ...]) -> list[dict[str, Any]]:
    return [{"position_m": c.position.tolist(), "length_m": c.length} for c in pieces]
