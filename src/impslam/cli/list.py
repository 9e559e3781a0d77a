"""`imp list`: the components of every role and their parameters."""

from __future__ import annotations

from importlib.resources import files
from itertools import takewhile
from typing import Annotated, Any, TypeAlias

from cyclopts import Parameter
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from impslam.cli import console
from impslam.cli.console import Common
from impslam.component import Component, components, near_miss, roles
from impslam.errors import ConfigError

INDENT = 4
ROBOT = "simulated-robot"
Row: TypeAlias = tuple[str, ...]
PluginConfig: TypeAlias = Annotated[
    str | None,
    Parameter(
        name=["--config", "-c"], help="A TOML file; lists the components of its plug-ins, too."
    ),
]


def list_components(
    role: str | None = None, /, *, config: PluginConfig = None, common: Common | None = None
) -> None:
    """Print the components of each role with their parameters: name, default, unit, meaning.

    Parameters
    ----------
    role
        A role (extractor, filter, association, ...), presets, worlds or simulated-robot. Default: all.
    """
    from impslam.config import load_plugins, presets
    from impslam.simulation.robot import SimulatedRobot
    from impslam.simulation.world import load_world, shipped_worlds

    del common
    if config is not None:
        load_plugins(config)
    known = [*roles(), "presets", "worlds", ROBOT]
    if role is not None and role not in known:
        role = next((name for name in known if role in (f"{name}s", name.rstrip("s"))), role)
    if role is not None and role not in known:
        raise ConfigError(f"no role is called {role!r}; {near_miss(role, known)}")
    for name in known if role is None else [role]:
        console.echo(name)
        if name == "presets":
            _show_names({preset: _title(preset) for preset in presets()})
        elif name == "worlds":
            _show_names({world: load_world(world).description for world in shipped_worlds()})
        elif name == ROBOT:
            console.show_columns(parameters(SimulatedRobot), 2 * INDENT)
        else:
            for component in components(name).values():
                _show(component)
        console.echo("")


def _title(preset: str) -> str:
    """Return the first sentence of the comment at the top of a preset's file."""
    text = files("impslam").joinpath("presets", f"{preset}.toml").read_text("utf-8")
    comment = takewhile(lambda line: line.startswith("#"), text.splitlines())
    words = " ".join(line.removeprefix("#").strip() for line in comment)
    sentence, dot, _ = words.partition(". ")
    return sentence + dot.strip()


def _show_names(names: dict[str, str]) -> None:
    console.show_columns(list(names.items()), INDENT // 2)


def _show(component: type[Component]) -> None:
    console.show_columns([(component.name, component.describe())], INDENT // 2)
    rows = [row for row in parameters(component) if row[0] != "path"]  # which is an argument
    if rows:
        console.show_columns(rows, 2 * INDENT)


def parameters(model: type[BaseModel], prefix: str = "", values: Any = None) -> list[Row]:
    """Return name, default, unit and description of each parameter; inner tables have dotted names."""
    rows: list[Row] = []
    for name, field in model.model_fields.items():
        default = _default(field) if values is None else getattr(values, name)
        if isinstance(default, BaseModel):
            rows += parameters(type(default), f"{prefix}{name}.", default)
        else:
            rows.append((prefix + name, _format(default), _unit(field), field.description or ""))
    return rows


def _default(field: FieldInfo) -> Any:
    return ... if field.is_required() else field.get_default(call_default_factory=True)


def _format(default: Any) -> str:
    """Return a default as written in a config file."""
    if default is ...:
        return "(required)"
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, float):
        return f"{default:.6g}"
    if isinstance(default, tuple):
        return str(list(default))
    return f'"{default}"' if isinstance(default, str) else str(default)


def _unit(field: FieldInfo) -> str:
    extra = field.json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    return "" if unit == "1" else unit
