"""`imp map`: commands on map files."""

from __future__ import annotations

from typing import Any

from cyclopts import App

from impslam.cli.console import help_text

COMMANDS = {
    "info": ("Print the contents of a map and draw it.", "office.imp"),
    "straighten": (
        "Rotate a map by up to 45° to align its walls with the axes.",
        "office.imp -o straight.imp",
    ),
    "diff": (
        "Show the changes between two maps of a place: walls that are gone, and new ones.",
        "monday.imp friday.imp -o changes.png",
    ),
    "merge": (
        "Merge maps of one building from several drives or robots, finding their relative poses.",
        "one.imp two.imp three.imp -o all.imp",
    ),
    "localise": (
        "Locate each scan of a log in a map, independently of the others.",
        "office.imp drive.mcap --every 10 -o places",
    ),
    "export": (
        "Export a map's grid, graph, landmarks and path to files for other programs.",
        "office.imp -o office",
    ),
}
"""Summary and example of each command NAME: the function NAME in `map_NAME`, imported when called."""

USAGES = {"merge": "Usage: imp map merge --output PATH [OPTIONS] FILES...\n"}
"""Usage of the command that needs several maps; cyclopts would call them optional."""

app = App(name="map")
for _number, (_name, (_summary, _example)) in enumerate(COMMANDS.items()):
    _help = help_text(_summary, f"map {_name}", _example)
    _more: dict[str, Any] = {"usage": USAGES[_name]} if _name in USAGES else {}
    _place = f"impslam.cli.map_{_name}:{_name}"
    app.command(_place, name=_name, help=_help, sort_key=_number, **_more)
