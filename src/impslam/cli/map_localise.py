"""`imp map localise`: locate the scans of a log in a map."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from impslam.cli import console
from impslam.cli.console import Common, ConfigName, Output, Settings, Topics, Whole

if TYPE_CHECKING:
    from impslam.localisation import Located

CSV, SUMMARY, PICTURE = "places.csv", "summary.json", "places.png"
FILES = frozenset({CSV, SUMMARY, PICTURE})


def localise(  # noqa: PLR0913  # each is an option that a user may give
    file: Path,
    log: Path,
    /,
    *,
    every: Annotated[Whole, Parameter(validator=validators.Number(gte=1))] = 1,
    config: ConfigName = None,
    output: Output = None,
    settings: Settings = (),
    topics: Topics = (),
    common: Common | None = None,
) -> None:
    """Locate each scan of a log in a map, independently of the others.

    Parameters
    ----------
    file
        A map file written by `imp run`.
    log
        A file or folder; its format is detected from its content.
    every
        Locate only every N-th scan.
    output
        Folder for places.csv, summary.json and places.png. Default: runs/LOG-places-DATE-TIME.
    """
    from impslam.cli.job import all_settings
    from impslam.cli.map_work import progress_line, result_folder
    from impslam.cli.output_files import json_text
    from impslam.cli.run_folder import log_stem
    from impslam.localisation import localise as located
    from impslam.map import Map
    from impslam.maps.files import map_image
    from impslam.observers.places_picture import places_png
    from impslam.paths import keep_inputs, written

    quiet = common is not None and common.quiet
    changes = all_settings(settings, topics)
    folder = output or Path("runs") / f"{log_stem(log)}-places-{time.strftime('%Y%m%d-%H%M%S')}"
    keep_inputs([file, log], [folder / one for one in FILES])
    known = Map.load(file)
    with progress_line("localising", quiet) as progress, result_folder(folder, FILES) as part:
        found = list(
            located(
                known, log, config, changes, every=every,
                progress=lambda position, total: progress(position / total) if total else None,
            )
        )  # fmt: skip
        facts = _facts(found)
        with written(folder, "give another -o"):
            (part / CSV).write_text(_table(found), "utf-8")
            (part / PICTURE).write_bytes(places_png(map_image(known.grid()), found))
            (part / SUMMARY).write_text(f"{json_text(facts)}\n", "utf-8")
    if not quiet:
        _show(facts, folder)


def _table(found: list[Located]) -> str:
    """Return a CSV row for each scan; x to score describe the best hypothesis."""
    rows = ["stamp,verdict,x,y,theta,probability,score,hypotheses"]
    for place in found:
        answer, pose = place.answer, ",,"
        best = ","
        if place.pose is not None:
            pose = ",".join(f"{value:.6f}" for value in place.pose)
            best = f"{answer.hypotheses[0].probability:.6f},{answer.hypotheses[0].score:.4f}"
        verdict, count = answer.verdict.value, len(answer.hypotheses)
        rows.append(f"{place.stamp:.9f},{verdict},{pose},{best},{count}")
    return "\n".join(rows) + "\n"


def _facts(found: list[Located]) -> dict[str, Any]:
    """Return the contents of summary.json."""
    import numpy as np

    counts = Counter(place.answer.verdict.value for place in found)
    seconds = 1e3 * np.array([place.seconds for place in found])
    names = ("found", "ambiguous", "nowhere")
    times = {"p50": float(np.median(seconds)), "max": float(seconds.max())}
    return {"scans": len(found), **{name: counts[name] for name in names}, "time_ms": times}


def _show(facts: dict[str, Any], folder: Path) -> None:
    meanings = {
        "found": "at one place",
        "ambiguous": "at several places, or uncertain",
        "nowhere": "at no place in the map",
    }
    scans = facts["scans"]
    rows = {
        name: f"{facts[name]} of {scans} scans ({100 * facts[name] / scans:.1f} %), {words}"
        for name, words in meanings.items()
    }
    times = facts["time_ms"]
    rows["time"] = f"median {times['p50']:.0f} ms per scan, maximum {times['max']:.0f} ms"
    console.show_facts({**rows, "written to": str(folder)})
