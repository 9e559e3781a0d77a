"""Reports of studies: sections with tables, pictures and numbers, and their files.

The files are a self-contained HTML page, the same as Markdown, an image for each picture, all numbers as
JSON, and the runs of each sweep as CSV.
"""

from __future__ import annotations

import base64
import csv
import json
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from impslam import __version__
from impslam.evaluation.json_values import json_values
from impslam.observers.page import escape, page, section, table
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row

PAGE, MARKDOWN, NUMBERS = "report.html", "report.md", "figures.json"

TITLE = "The thesis reproduced"
ABOUT = (
    "“Simultaneous Localization and Mapping on an Integrated Mobile Platform” (2015): its experiments in "
    "simulation, with the results beside the printed ones, and those of the default."
)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ResultTable:
    """A formatted table: cells are strings, units are in the header.

    The first `text` columns are text, the others numbers. `note` explains the table.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int = 1
    note: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture: stem of its file, content, caption, and kind ("png" or "svg")."""

    name: str
    content: bytes = field(repr=False)
    caption: str
    kind: str = "png"

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}.{self.kind}"


@dataclass(frozen=True, slots=True)
class Section:
    """One section of the page: method and results of a study.

    `numbers` are the values behind the tables by name, in m, rad, s or 1, for other programs (see
    `json_values`); `runs` are the rows of the study's sweep.
    """

    name: str
    title: str
    text: str
    tables: Sequence[ResultTable] = ()
    pictures: Sequence[Picture] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    runs: Sequence[Row] = ()


Study: TypeAlias = Callable[[Job], Section]
"""A study is a function; `impslam.cli.reproduce` lists them by name."""


def make_table(
    title: str,
    groups: Mapping[Any, T],
    columns: Mapping[str, Callable[[T], str]],
    note: str = "",
    labels: Sequence[str] = ("",),
) -> ResultTable:
    """Return a table with a row for each group: its label, then a cell for each column.

    Parameters
    ----------
    groups : by label, or by a tuple of labels
    columns : by header, the cell of a group
    labels : the headers of the columns of labels
    """
    rows = [
        [*((key,) if isinstance(key, str) else key), *(cell(group) for cell in columns.values())]
        for key, group in groups.items()
    ]
    return ResultTable(title, [*labels, *columns], rows, len(labels), note)


def load_text(name: str) -> dict[str, Any]:
    """Return the texts and settings of a study, from its TOML file beside this module."""
    text = (files("impslam.studies") / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def write(
    folder: Path, sections: Sequence[Section], command: str, missing: Sequence[str] = ()
) -> None:
    """Write all files into a folder.

    `command` is the command that produced them; experiments in `missing` were not finished.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for part in sections:
        for picture in part.pictures:
            (folder / picture.file).write_bytes(picture.content)
        if part.runs:
            _write_csv(folder / f"{part.name}.csv", part.runs)
    numbers = {part.name: part.numbers for part in sections}
    facts = {"command": command, "version": __version__, **numbers}
    partial = f"Partial: {', '.join(missing)} missing." if missing else ""
    if partial:
        facts["partial"] = partial
    made = f"Made by <code>{escape(command)}</code>, impslam {escape(__version__)}."
    banner = f'<p class="partial">{partial}</p>' * bool(partial)
    heading = f"<header><h1>{TITLE}</h1><p>{ABOUT} {made}</p>{banner}</header>"
    texts = {
        NUMBERS: json.dumps(json_values(facts), indent=2, allow_nan=False) + "\n",
        PAGE: "".join(page(f"{TITLE} · impslam", [heading, *map(_html, sections)])),
        MARKDOWN: f"# {TITLE}\n\n{ABOUT} Made by\n\n```sh\n{command}\n```\n\n"
        + f"**{partial}**\n\n" * bool(partial)
        + "\n".join(map(_markdown, sections)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write a table with a line for each run; arrays are left out."""
    names = dict.fromkeys(
        name for row in rows for name, v in row.items() if not hasattr(v, "shape")
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(names)
        lines.writerows([_csv_cell(row.get(name, "")) for name in names] for row in rows)


def _csv_cell(value: Any) -> Any:
    return ";".join(map(str, value)) if isinstance(value, tuple | list) else value


def _html(part: Section) -> str:
    paragraphs = "".join(f"<p>{escape(text)}</p>" for text in part.text.split("\n\n"))
    inner = [f'<div class="text">{paragraphs}</div>']
    inner += map(_html_table, part.tables)
    inner += map(_html_picture, part.pictures)
    return section(part.title, *inner)


def _html_table(shown: ResultTable) -> str:
    note = f'<p class="note">{escape(shown.note)}</p>' if shown.note else ""
    return f"<h2>{escape(shown.title)}</h2>{note}" + table(shown.header, shown.rows, shown.text)


def _html_picture(shown: Picture) -> str:
    data = base64.b64encode(shown.content).decode()
    kind = "image/svg+xml" if shown.kind == "svg" else "image/png"
    return (
        f'<figure class="picture"><img class="map" alt="{escape(shown.caption)}" '
        f'src="data:{kind};base64,{data}"><figcaption>{escape(shown.caption)}</figcaption></figure>'
    )


def _markdown(part: Section) -> str:
    blocks = [f"## {part.title}", part.text]
    for shown in part.tables:
        blocks += [f"**{shown.title}**", _markdown_table(shown), shown.note]
    blocks += [f"![{p.name}]({p.file})\n\n{p.caption}" for p in part.pictures]
    return "\n\n".join(filter(None, blocks)) + "\n"


def _markdown_table(shown: ResultTable) -> str:
    rule: Iterable[str] = ("---" if i < shown.text else "---:" for i in range(len(shown.header)))
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
        for row in (shown.header, rule, *shown.rows)
    )
