"""Selects the reader and the config for a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from impslam.component import build, explain, shorten
from impslam.config import Config, carried, load, load_plugins
from impslam.config_from_log import fitted
from impslam.errors import ConfigError, SourceError
from impslam.sources.base import Source, recognise

_ROLE_OPTIONS = (("topics", "--topic"), ("columns", "--columns"))
"""Parameters of logs that assign names by role, with their options."""


def open_log(
    log: str | Path, config: str | Path | Config | None = None, settings: Sequence[str] = ()
) -> tuple[Config, Source]:
    """Return the config of a run and the reader of its log, which is not open yet.

    `config` is the name of a preset, a file, or a config; by default the preset that fits the log.
    `settings` override it, each as "key=value". The log's description of its robot fills what the config
    leaves open: see `config_from_log`.

    Raises
    ------
    SourceError
        If the log cannot be read.
    ConfigError
        If the config is invalid, or names a stream that the log does not have.
    """
    if not isinstance(log, str | Path):
        raise SourceError(f"log = {shorten(log)}: expected the path of a file or folder")
    log = Path(log)
    odometry_is_free = config is None and not any(_sets(one, "odometry") for one in settings)
    if isinstance(config, Config):
        config = finished(config, settings)
    else:
        load_plugins(config or "default", settings)  # the log's reader may be among them
        kind = recognise(log)
        if config is None:
            with kind(path=log) as source:
                config = load(carried(source.preset, log), settings)
        else:
            config = load(config, settings)
    if "path" in config.source:
        raise ConfigError("source.path is not a parameter; give the log as an argument")
    robot = config.make_robot()
    wanted = dict.fromkeys((*config.source.get("wanted", ()), *robot.streams.wanted))
    parameters = {**config.source, "wanted": tuple(wanted)}
    if robot.streams.wanted:
        with _source(log, parameters) as source:
            robot.streams.check({stream.name: stream.used for stream in source.streams()})
    source = _source(log, parameters)
    if source.describes_robot:
        with source:
            config = fitted(config, source, odometry_is_free=odometry_is_free)
    return config, source


def for_continuing(config: Config, settings: Sequence[str] = ()) -> Config:
    """Return the config with an estimator that can continue a map: its own, or `graph`.

    An estimator chosen in the settings stays; if it cannot continue a map, it raises when it starts.
    """
    is_chosen = any(_sets(one, "estimator") for one in settings)
    if is_chosen or build("estimator", config.estimator).can_continue:
        return config
    return config.model_copy(update={"estimator": {"kind": "graph"}})


def _sets(setting: str, key: str) -> bool:
    """Return whether a setting is one of the table `key`."""
    return setting.partition("=")[0].strip().split(".")[0] == key


def _source(log: Path, parameters: Mapping[str, Any]) -> Source:
    kind = recognise(log)
    for key, option in _ROLE_OPTIONS:
        if key in parameters and key not in kind.model_fields:
            raise ConfigError(f"{log}: logs of kind {kind.name} have no {key}; leave out {option}")
    try:
        return kind(path=log, **parameters)
    except ValidationError as error:
        _refuse_unknown_roles(kind, parameters)
        known = set(kind.model_fields) - {"path"}
        raise ConfigError(explain(error, f"source ({kind.name})", known)) from None


def _refuse_unknown_roles(kind: type[Source], parameters: Mapping[str, Any]) -> None:
    """Raise for a topic or column that is assigned to a role that its format does not have."""
    for key, option in _ROLE_OPTIONS:
        if key in kind.model_fields and isinstance(given := parameters.get(key), Mapping):
            roles = get_args(get_args(kind.model_fields[key].annotation)[0])
            for role in given.keys() - set(roles):
                raise ConfigError(
                    f"{option} {role}: no such role; the roles are {', '.join(roles)}"
                )


def finished(config: str | Path | Config, settings: Sequence[str] = ()) -> Config:
    """Return the config of a preset or file with `settings` applied; return a `Config` as it is.

    Raises
    ------
    ConfigError
        If it is invalid, or if settings are given together with a `Config`.
    """
    if not isinstance(config, Config):
        return load(config, settings)
    if settings:
        raise ConfigError(
            "settings apply to a preset or a file, not to a Config; change the Config instead"
        )
    return config
