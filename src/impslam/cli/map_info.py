"""`imp map info`: the contents of a map."""

from __future__ import annotations

import math
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impslam.cli import console
from impslam.cli.console import Common, Output

if TYPE_CHECKING:
    from impslam.evaluation.quality import Quality
    from impslam.map import Map
    from impslam.maps.facts import MapFacts
    from impslam.maps.files import MapImage


def info(
    file: Path,
    /,
    *,
    output: Output = None,
    json: Path | None = None,
    common: Common | None = None,
) -> None:
    """Print the contents of a map and draw it.

    Parameters
    ----------
    file
        A map file written by `imp run`.
    output
        PNG file of the picture. Default: beside the map, with its name.
    json
        JSON file to write all numbers to.
    """
    from impslam.cli.map_work import progress_line
    from impslam.cli.output_files import check_png, write_json
    from impslam.evaluation.quality import quality
    from impslam.map import Map
    from impslam.maps.facts import facts
    from impslam.maps.files import map_image
    from impslam.paths import keep_inputs, write_bytes

    quiet = common is not None and common.quiet
    picture = output or file.with_suffix(".png")
    check_png(picture)
    keep_inputs([file], [picture, json])
    with progress_line("reading the map", quiet):
        known = Map.load(file)
    with progress_line("drawing the map", quiet):
        image = map_image(known.grid())
        found = facts(known, image, time.time())
        write_bytes(picture, _picture(known, image))
    with progress_line("comparing the scans", quiet):
        agreement = quality(known)
    if not quiet:
        console.echo(f"{file}:")
        partial = known.about.get("partial")
        rows = {
            **_rows(found),
            **({"partial": str(partial)} if partial else {}),
            "quality": _quality(agreement),
            "picture": str(picture),
        }
        console.show_facts(rows)
    if json is not None:
        write_json(json, {**_figures(found), "quality": agreement.figures()})


def _picture(known: Map, image: MapImage) -> bytes:
    """Draw a map: grid, path and landmarks."""
    import numpy as np

    from impslam.observers.map_picture import PictureContent, drawn_path, map_png

    none = np.empty((0, 2))
    return map_png(PictureContent(image, drawn_path(known), none, none, known.landmarks))


def _figures(found: MapFacts) -> dict[str, Any]:
    """Return the facts by their names in JSON, with units; numbers and shares have none."""
    direction = found.direction
    return {
        "logs": found.logs,
        "scans": found.scans,
        "keyframes": found.keyframes,
        "unplaced": found.unplaced,
        "path_m": found.path,
        "motions": found.motions,
        "closures": found.closures,
        "landmarks": found.landmarks,
        "extent_m": found.extent,
        "free_m2": found.free,
        "first_s": found.first,
        "last_s": found.last,
        "age_s": found.age,
        "direction": {
            "angle_rad": direction.angle,
            "sigma_rad": direction.sigma,
            "share": direction.share,
            "rival": direction.rival,
            "histogram": direction.histogram,
        },
    }


def _rows(found: MapFacts) -> dict[str, str]:
    """Return the facts in readable form."""
    from impslam.observers.summary import kinds

    left, right, bottom, top = found.extent
    marks = kinds(found.landmarks) or "none"
    lost = f", {found.unplaced} of them not placed in the map" if found.unplaced else ""
    graph = f"{found.motions} motions, {found.closures} closures" if found.motions else "none"
    return {
        "made from": ", ".join(filter(None, found.logs)) or "unknown",
        "age": _age(found),
        "path": f"{found.path:.1f} m, {found.scans} scans, {found.keyframes} keyframes{lost}",
        "graph": graph,
        "landmarks": marks,
        "area": f"{found.free:.0f} m² free",
        "extent": f"{right - left:.1f} x {top - bottom:.1f} m, x {left:.1f} to {right:.1f}, "
        f"y {bottom:.1f} to {top:.1f}",
        "walls": _walls(found),
    }


def _age(found: MapFacts) -> str:
    if math.isnan(found.age):
        return "unknown: the stamps of the log are not Unix time"
    last = datetime.fromtimestamp(found.last, UTC)
    days = found.age / 86400.0
    ago = f"{days:.0f} days" if days >= 2.0 else f"{24.0 * days:.1f} hours"
    return f"{ago}, last scan {last:%Y-%m-%d %H:%M} UTC"


def _walls(found: MapFacts) -> str:
    direction = found.direction
    if not direction.is_clear:
        return "no main direction"
    degrees = round(math.degrees(direction.angle), 1) + 0.0  # no -0.0
    return f"{100 * direction.share:.0f} % within 5° of {degrees:+.1f}° and its right angle"


def _quality(found: Quality) -> str:
    if math.isnan(found.disagreement):
        return "unknown: no surface is seen by two scans"
    return (
        f"scans disagree by {100 * found.disagreement:.1f} cm, free space contradicts "
        f"{100 * found.contradicted:.1f} % of their points, {100 * found.doubled:.1f} % on doubled "
        f"walls; {100 * found.revisited:.0f} % of the places revisited"
    )
