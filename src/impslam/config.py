"""Configuration: TOML in, components out.

A config starts from a preset, which a file and then `--set key=value` override. Its tables name
components by `kind`; the other keys of a table are that component's parameters. Another `kind` drops
the parameters of the previous one. `kind = "none"` removes a component. `plugins` names files
or modules with further components.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import FiniteFloat, ValidationError

from impslam import toml
from impslam.component import (
    build,
    components,
    explain,
    find,
    load_plugin,
    names,
    near_miss,
    parameter,
    shorten,
)
from impslam.errors import ConfigError
from impslam.estimators.base import Estimator
from impslam.filters.base import Filter
from impslam.landmarks.base import LandmarkModel
from impslam.map import Map
from impslam.maps.grid import MAX_RESOLUTION, MIN_RESOLUTION
from impslam.parameters import Parameters
from impslam.paths import is_file, read_text
from impslam.removed_components import without_removed
from impslam.robot import Robot
from impslam.settings import parse_setting
from impslam.tracking.base import KeyframeGate, Tracker
from impslam.types import Array

Table = dict[str, Any]


class Grid(Parameters):
    """The occupancy grid that a run writes."""

    resolution: float = parameter(0.05, "m", "side of a cell", ge=MIN_RESOLUTION, le=MAX_RESOLUTION)


class Config(Parameters):
    """All parameters of a run, as in TOML."""

    robot: str = parameter("robot", "", "name of the robot")
    seed: int = parameter(0, "", "seed of everything that samples", ge=0)
    plugins: tuple[str, ...] = parameter(
        (), "", "Python files or modules with further components; a config runs their code"
    )
    start: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = parameter(
        (0.0, 0.0, 0.0), "m, m, rad", "pose in map at the start"
    )
    source: Table = parameter({}, "", "parameters of the log reader (topics by role)")
    odometry: Table = parameter(..., "", "the motion of the robot, from wheels or other odometry")
    sensors: dict[str, Table] = parameter(..., "", "exteroceptive sensors, by name")
    tracker: Table = parameter({"kind": "odometry"}, "", "the motion between keyframes")
    estimator: Table = parameter(
        {"kind": "landmarks"}, "", "the map and the poses of the keyframes"
    )
    landmarks: dict[str, Table] = parameter({}, "", "parameters of landmark models, by kind")
    association: Table = parameter(..., "", "the matching of observations with landmarks")
    lifecycle: Table = parameter(..., "", "when landmarks are added and removed")
    filter: Table = parameter(..., "", "the joint estimate of pose and landmarks")
    keyframes: Table = parameter(
        {}, "", "which scans are keyframes; by default those of the estimator"
    )
    grid: Grid = parameter(Grid(), "", "the occupancy grid")

    def make_robot(self, *, for_estimator: bool = False) -> Robot:
        """Return the robot with fresh sensors.

        For an estimator that considers the systematic errors of odometry, its motions are without them.
        """
        return Robot(
            self.robot,
            build("odometry", self.odometry),
            {name: build("sensor", t, f"sensors.{name}") for name, t in self.sensors.items()},
            without_systematic=for_estimator and self._considers_systematic_errors(),
        )

    def make_tracker(self) -> Tracker:
        """Return the tracker, ready for the first sweep."""
        tracker: Tracker = build("tracker", self.tracker)
        tracker.start(np.array(self.start), self.make_gate())
        return tracker

    def _considers_systematic_errors(self) -> bool:
        """Return whether the filter considers the systematic errors of odometry.

        They need motions by odometry alone: scans that are matched correct most of the errors.
        """
        estimator: Estimator = build("estimator", self.estimator)
        belief: Filter = build("filter", self.filter)
        tracker: Tracker = build("tracker", self.tracker)
        considered = estimator.considers_systematic_errors and belief.considers_shared_errors
        return considered and not tracker.matches_scans

    def make_gate(self) -> KeyframeGate:
        """Return which scans are keyframes."""
        estimator: Estimator = build("estimator", self.estimator)
        defaults = estimator.keyframes.model_dump()
        try:
            return KeyframeGate(**{**defaults, **self.keyframes})
        except ValidationError as error:
            raise ConfigError(explain(error, "keyframes", KeyframeGate.model_fields)) from None

    def make_estimator(
        self, known: Map | None = None, *, frozen: bool = False, hint: Array | None = None
    ) -> Estimator:
        """Return the estimator, ready for its first keyframe, or for the next one of a known map."""
        estimator: Estimator = build("estimator", self.estimator)
        parts = {role: build(role, getattr(self, role)) for role in estimator.parts}
        self._check_unique(estimator)
        start, models = np.array(self.start), self.make_models()
        estimator.start(start, models=models, **parts)
        if known is not None:
            estimator.resume(known, frozen=frozen, hint=hint)
        return estimator

    def _check_unique(self, estimator: Estimator) -> None:
        for name, table in self.sensors.items():
            sensor = build("sensor", table, f"sensors.{name}")
            if sensor.observes_unique and not estimator.takes_unique:
                raise ConfigError(
                    f"sensors.{name}: the estimator {estimator.name!r} cannot use a {sensor.name}; "
                    "choose --set estimator.kind=landmarks"
                )

    def make_models(self) -> dict[str, LandmarkModel]:
        """Return all landmark models by kind."""
        known = components("landmark")
        for kind in self.landmarks:
            if kind not in known:
                raise ConfigError(f"landmarks.{kind}: no such kind; {near_miss(kind, known)}")
        return {
            kind: build("landmark", {"kind": kind, **self.landmarks.get(kind, {})})
            for kind in known
        }

    def resolved(self) -> Table:
        """Return all parameters, including defaults; loading them gives the same run."""
        table = self.model_dump(
            mode="json", exclude={"odometry", "sensors", "landmarks", "keyframes"}
        )
        table["odometry"] = _full("odometry", self.odometry)
        table["keyframes"] = self.make_gate().model_dump(mode="json")
        table["sensors"] = {}
        for name, sensor in self.sensors.items():
            full = _full("sensor", sensor)
            if "extractors" in sensor:
                full["extractors"] = {
                    key: _full("extractor", value) for key, value in sensor["extractors"].items()
                }
            table["sensors"][name] = full
        for role in ("tracker", "estimator", "association", "lifecycle", "filter"):
            table[role] = _full(role, getattr(self, role))
        table["landmarks"] = {
            kind: model.model_dump(mode="json", exclude_none=True)
            for kind, model in self.make_models().items()
            if type(model).model_fields
        }
        return table


def _full(role: str, table: Table) -> Table:
    """Return a component's table with its defaults written out."""
    plain = {key: value for key, value in table.items() if key != "extractors"}
    return {
        "kind": table["kind"],
        **build(role, plain).model_dump(mode="json", exclude={"extractors"}, exclude_none=True),
    }


def presets() -> list[str]:
    """Return the names of the shipped presets."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in files("impslam").joinpath("presets").iterdir()
        if entry.name.endswith(".toml")
    )


def read_table(name: str | Path) -> Table:
    """Return the raw table of a preset (by name) or of a TOML file, merged with its `base`."""
    return _layers(name)[-1][1]


def _layers(name: str | Path, derived: tuple[str, ...] = ()) -> list[tuple[str, Table]]:
    """Return the names and merged tables of a preset or file, after those that it is based on.

    `derived` are the presets and files of which it is the base.
    """
    path = Path(name)
    if str(name) in presets():
        text = files("impslam").joinpath("presets", f"{name}.toml").read_text("utf-8")
    elif is_file(path):
        if any(path.samefile(one) for one in derived):
            chain = " -> ".join(derived)
            raise ConfigError(f"{name}: is its own base ({chain}); name another base")
        text = read_text(path, "check the file", ConfigError)
    else:
        hint = near_miss(str(name), presets())
        raise ConfigError(f"{shorten(str(name))}: neither a file nor a preset; {hint}")
    table = toml.parse(text, str(name))
    base = table.pop("base", None)
    table = _with_plugin_paths(table, path.parent)
    if base is None:
        return [(str(name), table)]
    below = _layers(_base(str(base), path), (*derived, str(name)))
    return [*below, (str(name), _override(below[-1][1], table))]


def _base(name: str, file: Path) -> str:
    """Return a base: a preset, or a file relative to the folder of the file that names it."""
    if name in presets():
        return name
    path = file.parent / name
    if not is_file(path):
        known = near_miss(name, presets())
        raise ConfigError(
            f"{file}: base = {shorten(name)}: neither a preset nor the file {str(path)!r}; {known}"
        )
    return str(path)


def carried(preset: str, log: Path) -> Table:
    """Return the table that a log names for its mapping: a shipped preset, or a complete config.

    A log is untrusted data: it can choose neither code to run nor files to read.

    Raises
    ------
    ConfigError
        If it names something other than a shipped preset, or its config cannot be used.
    """
    if preset in presets():
        return read_table(preset)
    if "\n" not in preset:
        raise ConfigError(
            f"{log}: asks for the preset {shorten(preset)}, which is not a shipped one; name a "
            "preset or a config with -c"
        )
    try:
        table = _check_untrusted(toml.parse(preset, "its own config"))
        load(table)
    except ConfigError as error:
        raise ConfigError(f"{log}: {error}; name a preset or a config with -c") from None
    return table


def _check_untrusted(table: Table) -> Table:
    """Return a log's config; raise if it names code or files."""
    for key in ("plugins", "base"):
        if table.get(key):
            value = shorten(table[key])
            raise ConfigError(f"its own config has {key} = {value}, which a log may not choose")
    return table


def _with_plugin_paths(table: Table, folder: Path) -> Table:
    """Return the table with plug-in files relative to `folder`, that of the file that names them."""
    places = table.get("plugins")
    if not isinstance(places, list):
        return table
    return {**table, "plugins": [_plugin_path(place, folder) for place in places]}


def _plugin_path(place: Any, folder: Path) -> Any:
    if not isinstance(place, str) or not place.endswith(".py"):
        return place
    if "\0" in place:
        raise ConfigError(f"plugins: {place!r}: no such file; check the path")
    return str((folder / place).resolve())


def merge(below: Table, above: Mapping[str, Any]) -> Table:
    """Return `below` overridden by `above`; another `kind` replaces the whole table that contains it."""
    if "kind" in above and above["kind"] != below.get("kind"):
        below = {}
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(value, Mapping):
            merged[key] = merge(old if isinstance(old, dict) else {}, value)
        else:
            merged[key] = value
    return merged


def _override(below: Table, above: Mapping[str, Any]) -> Table:
    """Return a config overridden by another one, or by a setting.

    A resolved config lists the keyframes of its estimator; they do not suit another one.
    """
    merged = merge(below, above)
    if "keyframes" not in below:
        return merged
    before, after = (_estimator(table) for table in (below, merged))
    if before is None or before is after:
        return merged
    if below["keyframes"] != before.keyframes.model_dump(mode="json"):
        return merged
    return {**merged, "keyframes": dict(above.get("keyframes", {}))}


def _estimator(table: Table) -> type[Estimator] | None:
    """Return the estimator that a config names; None if it names none, or one that is unknown so far."""
    named = table.get("estimator")
    kind = named.get("kind") if isinstance(named, Mapping) else None
    if kind not in names("estimator"):
        return None
    found = find("estimator", kind)
    return found if issubclass(found, Estimator) else None


def load(base: str | Path | Table = "default", settings: Sequence[str] = ()) -> Config:
    """Return the config of a preset, file or table with settings applied, every component checked.

    Raises
    ------
    ConfigError
        One line with the key and what to do, e.g. the closest known key, or the bound.
    """
    layers = _base_layers(base)
    table = _with_settings(layers[-1][1], settings)
    try:
        return _checked(table)
    except ConfigError as error:
        raise ConfigError(_culprit(layers, str(error)) + str(error)) from error.__cause__


def _culprit(layers: Sequence[tuple[str, Table]], said: str) -> str:
    """Return "NAME: " for the first layer that is faulty in the same way without those above; else ""."""
    for name, table in layers:
        try:
            _checked(table)
        except ConfigError as error:
            if name and str(error) == said:
                return f"{name}: "
    return ""


def _checked(table: Table) -> Config:
    """Return the config of a table; raise if it, or a component that it describes, is faulty."""
    table = without_removed(table)
    _load_plugins(table)
    _check_no_bare_sensor(table)
    try:
        config = Config(**table)
    except ValidationError as error:
        raise ConfigError(explain(error, "", Config.model_fields)) from None
    robot, tracker = config.make_robot(), config.make_tracker()
    if not robot.odometry.measures_motion and not tracker.matches_scans:
        raise ConfigError(
            f"odometry.kind = {robot.odometry.name!r}: the tracker {tracker.name!r} needs odometry; "
            "match scans instead: --set tracker.kind=scan_to_map"
        )
    config.make_estimator()
    for role in ("association", "lifecycle", "filter"):  # even if the estimator does not use it
        build(role, getattr(config, role))
    return config


def _check_no_bare_sensor(table: Table) -> None:
    """Raise for a table that is named as a sensor, e.g. `lidar` instead of `sensors.lidar`."""
    sensors = table.get("sensors")
    for name in table.keys() - Config.model_fields.keys():
        if isinstance(sensors, Mapping) and name in sensors:
            part = table[name]
            key = f"{name}.{next(iter(part))}" if isinstance(part, Mapping) and part else name
            raise ConfigError(f"{key} is not a parameter; did you mean 'sensors.{key}'?")


def load_plugins(base: str | Path = "default", settings: Sequence[str] = ()) -> None:
    """Register the components of the plug-ins of a config, for use before `load`."""
    _load_plugins(_with_settings(_base_layers(base)[-1][1], settings))


def _load_plugins(table: Table) -> None:
    places = table.get("plugins", ())
    if not isinstance(places, list | tuple) or not all(isinstance(p, str) for p in places):
        raise ConfigError(f'plugins = {places!r}: expected a list, e.g. plugins = ["my_filter.py"]')
    for place in places:
        load_plugin(place)


def _base_layers(base: str | Path | Table) -> list[tuple[str, Table]]:
    """Return a table without a name, or the layers of a preset or file."""
    if not isinstance(base, str | Path | dict):
        raise ConfigError(f"config = {shorten(base)}: expected a preset's name or a file")
    return [("", base)] if isinstance(base, dict) else _layers(base)


def _with_settings(table: Table, settings: Sequence[str]) -> Table:
    if isinstance(settings, str) or not all(isinstance(one, str) for one in settings):
        raise ConfigError(f'settings = {shorten(settings)}: expected a list, e.g. ["seed=1"]')
    for setting in settings:
        table = _override(table, _with_plugin_paths(parse_setting(setting), Path()))
    return table
