"""`imp config`: print every parameter of a run with its value and unit."""

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
    """Print all parameters of a preset or TOML file, as a config that can be loaded.

    Parameters
    ----------
    preset
        A preset or a TOML file.
    """
    import tomli_w

    from impslam.config import load

    del common
    table = load(preset, settings).resolved()
    console.echo(with_units(tomli_w.dumps(table), dict(units(table))))


def with_units(text: str, units_by_name: Mapping[str, str]) -> str:
    """Return TOML with the unit of each value as a comment, and each list on one line."""
    lines, table = [], ""
    for line in LIST.sub(_on_one_line, text).splitlines():
        if header := HEADER.match(line):
            table = f"{header[1]}."
        unit = units_by_name.get(table + line.partition(" = ")[0], "")
        lines.append(f"{line}  # {unit}" if unit else line)
    return "\n".join(lines)


def _on_one_line(match: re.Match[str]) -> str:
    return "[" + ", ".join(line.strip().rstrip(",") for line in match[1].splitlines()) + "]"


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
    """Return the model that declares the parameters of a table; None for a part of another one's table."""
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
