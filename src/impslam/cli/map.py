"""`imp map`: what can be done with a map's file."""

from __future__ import annotations

from cyclopts import App

from impslam.cli.console import described

COMMANDS = {
    "info": ("Print what a map holds, and draw it.", "office.imp"),
    "straighten": (
        "Turn a map, by 45° at most, so that its walls are along the axes.",
        "office.imp -o straight.imp",
    ),
    "diff": (
        "Show what has changed between two maps of a place: walls that are gone, and new ones.",
        "monday.imp friday.imp -o changes.png",
    ),
    "merge": (
        "Merge maps of one building, from several drives or robots; their relative poses are found.",
        "one.imp two.imp three.imp -o all.imp",
    ),
    "localise": (
        "Locate each scan of a log in a map, independently of the others.",
        "office.imp drive.mcap --every 10 -o places",
    ),
    "export": (
        "Write a map's grid, graph, landmarks and path as files for other programs.",
        "office.imp -o office",
    ),
}
"""What each command does, and an example; NAME is the function in `map_NAME`, imported when called."""

app = App(name="map")
for _name, (_sentence, _example) in COMMANDS.items():
    _help = described(_sentence, f"map {_name}", _example)
    app.command(f"impslam.cli.map_{_name}:{_name}", name=_name, help=_help)
