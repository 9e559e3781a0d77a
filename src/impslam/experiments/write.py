"""The page of what was reproduced: one HTML file that needs nothing else, the PNGs, the numbers."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path

from impslam import __version__
from impslam.experiments.base import Part, Picture, Table
from impslam.observers.page import escape, page, section, table

PAGE, FIGURES = "report.html", "figures.json"


def write(folder: Path, parts: Sequence[Part], command: str) -> None:
    """Write the page, a PNG for each picture, and all numbers as JSON.

    `command` is the one that made them; the page says so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for part in parts:
        for picture in part.pictures:
            (folder / f"{picture.name}.png").write_bytes(picture.png)
    numbers = {part.name: part.figures for part in parts}
    text = json.dumps({"command": command, "version": __version__, **numbers}, indent=2)
    (folder / FIGURES).write_text(text + "\n", encoding="utf-8")
    sections = [_heading(command), *map(_section, parts)]
    (folder / PAGE).write_text(page("The thesis reproduced · impslam", sections), encoding="utf-8")


def _heading(command: str) -> str:
    return (
        "<header><h1>The thesis reproduced</h1>"
        "<p>“Simultaneous Localization and Mapping on an Integrated Mobile Platform” (2015), its "
        "experiments in the simulated arena beside its print, and what the default does. Lengths "
        f"in the tables say their unit. Made by <code>{escape(command)}</code>, impslam "
        f"{escape(__version__)}.</p></header>"
    )


def _section(part: Part) -> str:
    paragraphs = "".join(f"<p>{escape(text)}</p>" for text in part.text.split("\n\n"))
    inner = [f'<div class="text">{paragraphs}</div>']
    inner += map(_table, part.tables)
    inner += map(_picture, part.pictures)
    return section(part.title, *inner)


def _table(shown: Table) -> str:
    note = f'<p class="note">{escape(shown.note)}</p>' if shown.note else ""
    return f"<h2>{escape(shown.title)}</h2>{note}" + table(shown.header, shown.rows, shown.text)


def _picture(shown: Picture) -> str:
    data = base64.b64encode(shown.png).decode()
    return (
        f'<figure class="picture"><img class="map" alt="{escape(shown.caption)}" '
        f'src="data:image/png;base64,{data}"><figcaption>{escape(shown.caption)}</figcaption></figure>'
    )
