"""What was reproduced: one HTML page that needs nothing else, the same as Markdown, PNGs, numbers."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path

from impslam import __version__
from impslam.observers.page import escape, page, section, table
from impslam.studies.base import Part, Picture, Table

PAGE, MARKDOWN, FIGURES = "report.html", "report.md", "figures.json"

TITLE = "The thesis reproduced"
ABOUT = (
    "“Simultaneous Localization and Mapping on an Integrated Mobile Platform” (2015): its experiments "
    "in the simulated arena beside its print, and what the default does."
)


def write(folder: Path, parts: Sequence[Part], command: str) -> None:
    """Write the page (HTML and Markdown), a PNG for each picture, and all numbers as JSON.

    `command` is the one that made them; the page says so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for part in parts:
        for picture in part.pictures:
            (folder / f"{picture.name}.png").write_bytes(picture.png)
    numbers = {part.name: part.figures for part in parts}
    figures = json.dumps({"command": command, "version": __version__, **numbers}, indent=2)
    sections = [_heading(command), *map(_section, parts)]
    texts = {
        FIGURES: figures + "\n",
        PAGE: page(f"{TITLE} · impslam", sections),
        MARKDOWN: f"# {TITLE}\n\n{ABOUT} Made by\n\n```sh\n{command}\n```\n\n"
        + "\n".join(map(_markdown, parts)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _heading(command: str) -> str:
    made = f"Made by <code>{escape(command)}</code>, impslam {escape(__version__)}."
    return f"<header><h1>{TITLE}</h1><p>{ABOUT} {made}</p></header>"


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


def _markdown(part: Part) -> str:
    blocks = [f"## {part.title}", part.text]
    for shown in part.tables:
        blocks += [f"**{shown.title}**", _markdown_table(shown), shown.note]
    blocks += [f"![{p.name}]({p.name}.png)\n\n{p.caption}" for p in part.pictures]
    return "\n\n".join(filter(None, blocks)) + "\n"


def _markdown_table(shown: Table) -> str:
    rule = ["---" if i < shown.text else "---:" for i in range(len(shown.header))]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
        for row in (shown.header, rule, *shown.rows)
    )
