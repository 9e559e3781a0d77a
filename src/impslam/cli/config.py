"""`imp config`: every parameter of a run with its value and unit."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from impslam.cli import console
from impslam.cli.console import Common, Settings

if TYPE_CHECKING:
    from pydantic import BaseModel

HEADER = re.compile(r"\[(.+)\]$")
LIST = re.compile(r"\[\n((?:    .*,\n)*)\]$", re.MULTILINE)


def config(
    preset: str = "default", /, *, settings: Settings = (), common: Common | None = None
) -> None:
    """Print a preset or TOML file with every parameter in it; what is printed loads again.

    Parameters
    ----------
    preset
        Name of a preset, or a TOML file.
    """
    import tomli_w

    from impslam.config import load

    del common
    table = load(preset, settings).resolved()
    console.say(with_units(tomli_w.dumps(table), dict(units(table))))


def with_units(text: str, known: Mapping[str, str]) -> str:
    """Return TOML with the unit of each value as a comment, and each list on one line."""
    lines, table = [], ""
    for line in LIST.sub(_on_one_line, text).splitlines():
        if header := HEADER.match(line):
            table = f"{header[1]}."
        unit = known.get(table + line.partition(" = ")[0], "")
        lines.append(f"{line}  # {unit}" if unit else line)
    return "\n".join(lines)


def _on_one_line(found: re.Match[str]) -> str:
    return "[" + ", ".join(line.strip().rstrip(",") for line in found[1].splitlines()) + "]"


def units(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield the dotted name and the unit of every parameter in a config's table."""
    from impslam.cli.list import parameters

    model = _model(path, table)
    for name, _, unit, _ in [] if model is None else parameters(model):
        yield ".".join([*path, name]), unit
    for name, inner in table.items():
        if isinstance(inner, Mapping):
            yield from units(inner, (*path, name))


def _model(path: tuple[str, ...], table: Mapping[str, Any]) -> type[BaseModel] | None:
    """Return what declares the parameters of the table at a path, if it is more than a part of one."""
    from impslam.component import find
    from impslam.config import Config
    from impslam.tracking.base import KeyframeGate

    match path:
        case ():
            return Config
        case ("keyframes",):
            return KeyframeGate
        case ("landmarks", kind):
            return find("landmark", kind)
        case (*_, "sensors" | "extractors" as role, _):
            return find(role.removesuffix("s"), table["kind"])
        case (role,) if "kind" in table:
            return find(role, table["kind"])
    return None
