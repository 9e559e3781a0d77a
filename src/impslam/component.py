"""Components: replaceable classes, found by name, whose fields are their parameters.

A component is a frozen pydantic model. Its fields are its parameters, each with a unit and a
description; its methods implement its role. A role is a direct subclass of `Component`
(`Extractor`, `Filter`, ...), and every class below a role registers itself in that role:

    @register("hough")
    class Hough(Extractor): ...

Third parties register in the entry-point group `impslam.components`: each entry point names a module,
whose `@register` lines run when it is imported. `plugins` in the config names components that are not
installed, as files or modules.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from impslam.errors import ConfigError
from impslam.parameters import Parameters, unit_of
from impslam.parameters import parameter as parameter  # noqa: PLC0414  # part of this interface
from impslam.paths import is_file

_ROLES: dict[str, dict[str, type[Component]]] = {}
_PACKAGES = {
    "association": "impslam.association",
    "device": "impslam.platform.devices",
    "estimator": "impslam.estimators",
    "extractor": "impslam.extractors",
    "filter": "impslam.filters",
    "landmark": "impslam.landmarks",
    "lifecycle": "impslam.lifecycle",
    "odometry": "impslam.odometry",
    "sensor": "impslam.sensors",
    "source": "impslam.sources",
    "tracker": "impslam.tracking",
}
"""The package of each role; a component is imported when it is first requested."""
_REGISTRATION = re.compile(r'^@register\("([^"]+)"\)', re.MULTILINE)

C = TypeVar("C", bound="Component")


class Component(Parameters):
    """A replaceable class. Fields are parameters; mutable state is in private attributes."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    role: ClassVar[str] = ""
    name: ClassVar[str] = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Make private attributes ten times as fast as pydantic's: each keyframe accesses dozens."""
        super().__pydantic_init_subclass__(**kwargs)
        for name in vars(cls)["__private_attributes__"]:
            if name not in vars(cls):
                setattr(cls, name, _private(name))

    @model_validator(mode="before")
    @classmethod
    def _merge_defaults(cls, table: Any) -> Any:
        """Complete a partly given nested parameter with the defaults of that parameter."""
        if not isinstance(table, dict):
            return table
        merged = dict(table)
        for name, field in cls.model_fields.items():
            if isinstance(field.default, BaseModel) and isinstance(table.get(name), dict):
                merged[name] = {**field.default.model_dump(), **table[name]}
        return merged

    @classmethod
    def describe(cls) -> str:
        """Return the first line of the class's docstring."""
        return (cls.__doc__ or "").strip().split("\n", 1)[0]


def _private(name: str) -> property:
    """Return a property that reads a private attribute, which pydantic writes."""

    def get(self: Component) -> Any:
        try:
            return self.__pydantic_private__[name]  # type: ignore[index]
        except (KeyError, TypeError):
            raise AttributeError(f"{type(self).__name__} has no {name!r} yet") from None

    return property(get)


def register(name: str) -> Callable[[type[C]], type[C]]:
    """Register a component as `name` in the role of its base class."""

    def add(cls: type[C]) -> type[C]:
        if cls.role in _PACKAGES and not cls.__module__.startswith(f"{_PACKAGES[cls.role]}."):
            _import_named(cls.role, name)  # so that the error below names the plug-in
        known = _ROLES.setdefault(cls.role, {})
        if name in known and _qualified_name(known[name]) != _qualified_name(cls):
            raise ConfigError(
                f"{cls.role} {name!r} is registered twice, by {known[name].__module__} and "
                f"{cls.__module__}; rename one"
            )
        cls.name = name
        known[name] = cls
        return cls

    return add


def _qualified_name(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__


@functools.cache
def _index(role: str) -> dict[str, str]:
    """Return the module of each component of a role by its name, from the source of the package.

    This avoids importing a whole role, with its dependencies, for one of its components. If the source is
    not available (a package in a zip file), the index is empty and the whole role is imported.
    """
    package = importlib.import_module(_PACKAGES[role])
    return {
        name: f"{package.__name__}.{file.stem}"
        for folder in package.__path__
        for file in Path(folder).glob("*.py")
        for name in _REGISTRATION.findall(file.read_text("utf-8"))
    }


def _import_named(role: str, name: str) -> None:
    """Import the module of one component if it is in the package of its role."""
    module = _index(role).get(name) if role in _PACKAGES else None
    if module is not None:
        importlib.import_module(module)


@functools.cache
def _import_role(role: str) -> None:
    """Import all modules of a role once, which registers its components."""
    package = importlib.import_module(_PACKAGES[role])
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)


def load_entry_points() -> None:
    """Import the plug-ins of installed packages; raise `ConfigError` with the name of one that fails."""
    for entry in entry_points(group="impslam.components"):
        _import_guarded(f"plug-in {entry.name} = {entry.value}", entry.load)


def load_plugin(place: str) -> None:
    """Import a plug-in, once: a Python file, or a module by its dotted name.

    Raises
    ------
    ConfigError
        If it is missing or cannot be imported.
    """
    if not place.endswith(".py"):
        _import_guarded(f"plugins: {place}", lambda: importlib.import_module(place))
        return
    path = Path(place).resolve()
    if not is_file(path):
        raise ConfigError(f"plugins: {place}: no such file; check the path")
    # Files with the same name in different folders are different modules.
    name = f"impslam_plugin_{path.stem}_{zlib.crc32(str(path).encode()):08x}"
    if name not in sys.modules:
        _import_guarded(f"plugins: {place}", lambda: _import_file(name, path))


def _import_file(name: str, path: Path) -> None:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


def _import_guarded(what: str, load: Callable[[], object]) -> None:
    """Import third-party code; report any exception in one line."""
    try:
        load()
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        text = f"{what}: cannot be imported: {type(error).__name__}: {error}"
        if isinstance(error, ImportError) and str(error.name).startswith("impslam."):
            text += "; it is written for another version of impslam, see CHANGELOG.md"
        raise ConfigError(text) from error


_load_entry_points_once = functools.cache(load_entry_points)


def components(role: str) -> Mapping[str, type[Component]]:
    """Return the registered components of a role, by name."""
    if role in _PACKAGES:
        _import_role(role)
    _load_entry_points_once()
    return dict(sorted(_ROLES.get(role, {}).items()))


def names(role: str) -> list[str]:
    """Return the names of the components of a role without importing those of this package."""
    _load_entry_points_once()
    known = _index(role) if role in _PACKAGES else None
    return sorted({*known, *_ROLES.get(role, ())}) if known else list(components(role))


def roles() -> list[str]:
    """Return the names of all roles that have a component."""
    _load_entry_points_once()
    return sorted({*_PACKAGES, *_ROLES})


_EXPECTED = {
    "int_parsing": "a whole number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "float_type": "a number",
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "string_type": "text in quotes",
}
"""What a value of a wrong type should have been, by pydantic's type of the error."""
_WORDING = (
    ("Value error, ", ""),
    ("Input should be", "must be"),
    ("greater than or equal to", "at least"),
    ("less than or equal to", "at most"),
)


def near_miss(word: str, known: Any, listed: Sequence[str] | None = None) -> str:
    """Return a hint with the closest known word, or with all of them, as `listed` or sorted."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"known: {', '.join(sorted(known) if listed is None else listed)}"


def find(role: str, name: str) -> type[Component]:
    """Return the component class of a role by its name.

    Raises
    ------
    ConfigError
        If there is none; the message names the closest one.
    """
    _import_named(role, name)
    if name in _ROLES.get(role, {}):
        return _ROLES[role][name]
    known = components(role)
    if name not in known:
        raise ConfigError(f"no {role} is called {name!r}; {near_miss(name, known)}")
    return known[name]


def build(role: str, table: Any, where: str = "") -> Any:
    """Make a component from a config table: `kind` names it, the other keys are its parameters."""
    if not isinstance(table, Mapping):
        here = where or role
        raise ConfigError(f"{here} = {table!r}: expected a table, e.g. {here}.kind = NAME")
    rest = dict(table)
    if "kind" not in rest:
        raise ConfigError(f"[{where or role}] lacks 'kind'; known: {', '.join(components(role))}")
    cls = _find_named(role, str(rest.pop("kind")), where or role)
    _check_complete(cls)
    try:
        return cls(**rest)
    except ValidationError as error:
        known = {**cls.model_fields, "kind": None}
        raise ConfigError(explain(error, where or role, known)) from None


def _find_named(role: str, name: str, where: str) -> type[Component]:
    """Return the component class that the table `where` names; errors say where."""
    try:
        return find(role, name)
    except ConfigError as error:
        raise ConfigError(f"{where}.kind: {error}") from None


def _check_complete(cls: type[Component]) -> None:
    """Raise for a component that lacks attributes of its role, e.g. one for an older impslam."""
    lacks = set(getattr(cls, "__abstractmethods__", ()))
    for base in cls.__mro__:
        if base.__module__.startswith("impslam."):
            named = inspect.get_annotations(base).items()
            lacks |= {n for n, kind in named if "ClassVar" in str(kind) and not hasattr(cls, n)}
    if lacks:
        contract = next(base for base in reversed(cls.__mro__) if getattr(base, "role", ""))
        raise ConfigError(
            f"{cls.role} {cls.name!r} ({cls.__module__}.{cls.__qualname__}) lacks "
            f"{', '.join(sorted(lacks))}: update it for this version of impslam; the contract is "
            f"{contract.__qualname__} in {contract.__module__}"
        )


def explain(error: ValidationError, where: str, known: Any) -> str:
    """Turn a pydantic error into one line: what, where and what to do."""
    # A misspelt key comes first: the key that was meant is missing because of it.
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    path = ".".join(str(part) for part in (where, *first["loc"]) if part != "")
    if first["type"] == "extra_forbidden":
        inner = _fields_within(first["loc"][:-1], known)
        return f"{path} is not a parameter; {near_miss(str(first['loc'][-1]), inner)}"
    if first["type"] == "missing":
        lost = [one["loc"] for one in error.errors() if one["type"] == "missing"]
        if isinstance(lost[0][-1], int):
            return f"{path} is missing; {_numbers_of(_field(lost[0], known))}"
        *others, last = (_describe_missing(loc, where, known) for loc in lost)
        rest = f"{', '.join(others)} and {last} are missing; add them"
        return rest if others else f"{last} is missing; add it"
    value = shorten(first.get("input"))
    if first["type"] == "dict_type":
        return f"{path} = {value}: expected a table, e.g. {path}.kind = NAME"
    said = _plain(first["type"], first["msg"], _field(first["loc"], known))
    return f"{path} = {value}: {said}{_unit_of_bound(first['type'], first['loc'], known)}"


def _plain(kind: str, message: str, field: Any) -> str:
    """Return pydantic's message on a value of a field in the words of the other messages."""
    if kind in _EXPECTED:
        return f"must be {_EXPECTED[kind]}"
    annotation = getattr(field, "annotation", None)
    if kind == "model_type":
        return (
            f"must be {'none or ' if NoneType in get_args(annotation) else ''}a table of parameters"
        )
    if kind == "tuple_type" and (count := _count(annotation)):
        example = ",".join(f"0.{number + 1}" for number in range(count))
        return f"must be a list of {count} numbers, e.g. [{example}]"
    for theirs, ours in _WORDING:
        message = message.replace(theirs, ours)
    return message


def _count(annotation: Any) -> int:
    """Return how many numbers a parameter has, e.g. 3 for a pose; 0 if it has no fixed number of them."""
    kinds = (annotation, *get_args(annotation))  # the second part is for `tuple[...] | None`
    parts = next((get_args(kind) for kind in kinds if get_origin(kind) is tuple), ())
    return 0 if Ellipsis in parts else len(parts)


def _numbers_of(field: Any) -> str:
    """Return what to write for a parameter that lacks numbers, with their units and meaning."""
    count, extra = _count(getattr(field, "annotation", None)), _extra(field)
    return (
        f"give {count} numbers ({extra['unit']}; {field.description})"
        if count and extra
        else "add it"
    )


def _unit_of_bound(kind: str, loc: Sequence[int | str], known: Any) -> str:
    """Return the unit of a bound with a blank before it; "" for other errors, or without a unit."""
    if not kind.startswith(("greater_than", "less_than")):
        return ""
    unit = _unit(_field(loc, known), loc)
    return "" if unit in {"", "1"} else f" {unit}"


def _describe_missing(loc: Sequence[int | str], where: str, known: Any) -> str:
    """Return the name of a missing parameter, with its unit and meaning if they are known."""
    path = ".".join(str(part) for part in (where, *loc) if part != "")
    field = _field(loc, known)
    unit = _unit(field, loc)
    return f"{path} ({unit}, {field.description})" if unit else path


def _field(loc: Sequence[int | str], known: Any) -> Any:
    """Return the field at a place, or the one that contains a number there; None if it is unknown."""
    names = tuple(part for part in loc if isinstance(part, str))
    fields = _fields_within(names[:-1], known)
    return fields.get(names[-1]) if names and isinstance(fields, Mapping) else None


def _extra(field: Any) -> dict[str, Any]:
    """Return what `parameter` stores about a field; nothing for other fields."""
    extra = getattr(field, "json_schema_extra", None)
    return extra if isinstance(extra, dict) else {}


def _unit(field: Any, loc: Sequence[int | str]) -> str:
    """Return the unit of a field, or of its number at a place such as ("mount", 2); "" without one."""
    unit = str(_extra(field).get("unit", ""))
    return unit_of(unit, loc[-1]) if isinstance(loc[-1], int) else unit


def shorten(value: object) -> str:
    """Return the repr of a value in at most 60 characters, for messages."""
    try:
        text = repr(value)
    except ValueError:  # Python limits the digits of integers
        text = "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _fields_within(path: tuple[int | str, ...], known: Any) -> Any:
    """Return the fields of the inner table at a path, or `known` if there is no such table."""
    for part in path:
        kind = getattr(known.get(part), "annotation", None) if isinstance(known, Mapping) else None
        models = (kind, *get_args(kind))  # the second part is for `Model | None`
        inner = [m.model_fields for m in models if isinstance(m, type) and issubclass(m, BaseModel)]
        if not inner:
            break
        known = inner[0]
    return known
