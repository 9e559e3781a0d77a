"""Settings of the command line, such as `--set filter.kind=ekf`, as tables."""

from __future__ import annotations

from typing import Any

from impslam import toml
from impslam.component import shorten
from impslam.errors import ConfigError


def parse_setting(setting: str) -> dict[str, Any]:
    """Turn "a.b=value" into {"a": {"b": value}}; a value that is not TOML is a string."""
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {setting}: expected key=value, e.g. --set filter.kind=ekf")
    try:
        value = toml.parse(f"value = {text}", f"--set {key}")["value"]
    except toml.TomlSyntaxError:
        value = text.strip()
    if value == {}:
        raise ConfigError(
            f"--set {shorten(setting)}: an empty table changes nothing; to switch a component off, set its "
            "kind to none, e.g. --set sensors.lidar.extractors.walls.kind=none"
        )
    parts = key.strip().split(".")
    if len(parts) > toml.MAX_DEPTH:
        raise ConfigError(f"--set {shorten(key)}: no such key; `imp config` shows them all")
    for part in reversed(parts):
        value = {part: value}
    return dict(value)
