"""Pages of the site that are made when it is built: commands, components, and the notebook."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from griffe import Extension, Object
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from impslam.cli.app import make_app
from impslam.cli.list import parameters
from impslam.component import Component, components, roles

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from the program, and those that lie beside the docs."""
    for name, text in {
        "commands.md": commands(),
        "components.md": all_components(),
        "notebook.md": notebook(json.loads((ROOT / "docs/notebook.ipynb").read_text("utf-8"))),
    }.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Point links at the notebook's page; the one on that page is for downloading."""
    here = page.file.src_uri == "notebook.md"
    return markdown if here else markdown.replace("(notebook.ipynb)", "(notebook.md)")


def commands() -> str:
    """Return the help of every command."""
    return make_app().generate_docs(heading_level=1, flatten_commands=False)


def all_components() -> str:
    """Return the components of every role with their parameters, as `imp list` prints them."""
    text = ["# Components", INTRODUCTION]
    for role in roles():
        text += [f"## {role}", *map(_component, components(role).values())]
    return "\n\n".join(text)


INTRODUCTION = """\
Each role of the program is played by a component that a config chooses by its `kind`. These are the
components that come with it, as `imp list` prints them, with the default and the unit of each parameter."""


def _component(kind: type[Component]) -> str:
    rows = [row for row in parameters(kind) if row[0] != "path"]
    text = [f"### {kind.name}", kind.describe()]
    if rows:
        head = "| Parameter | Default | Unit | Meaning |\n|---|---|---|---|"
        text.append("\n".join([head, *(_row(*row) for row in rows)]))
    return "\n\n".join(text)


def _row(name: str, default: str, unit: str, meaning: str) -> str:
    return f"| `{name}` | `{default}` | {unit} | {meaning.replace('|', '&#124;')} |"


def notebook(book: dict[str, Any]) -> str:
    """Return a Jupyter notebook with its outputs as Markdown."""
    return "\n\n".join(map(_cell, book["cells"]))


def _cell(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    return "\n\n".join([f"```python\n{source}\n```", *map(_output, cell["outputs"])])


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        picture = base64.b64decode(data["image/png"])
        return f"![picture](data:image/png;base64,{base64.b64encode(picture).decode()})"
    return f"```text\n{''.join(output.get('text', data.get('text/plain', '')))}\n```"


class Docstrings(Extension):
    """Takes `name : sentence` in a docstring for what it is: types are in the signature."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Put the sentence on the next line, where the parser looks for it."""
        if obj.docstring:
            obj.docstring.value = ENTRY.sub(r"\1\n    \2", obj.docstring.value)


ENTRY = re.compile(r"^(\w+(?:, \w+)*) : (.+)$", re.MULTILINE)
