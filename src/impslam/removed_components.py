"""Remove components from a config: tables with `kind = "none"`."""

from __future__ import annotations

from typing import Any

from impslam.errors import ConfigError

_WITHOUT = {
    "odometry": "to map with the lidar alone, set odometry.kind=lidar_only",
    "tracker": 'every run has one; use kind = "odometry"',
    "estimator": 'every run has one; use kind = "landmarks"',
    **dict.fromkeys(
        ("association", "lifecycle", "filter"),
        "leave it as it is; estimators that do not need it ignore it",
    ),
}
"""What to write instead of `kind = "none"` for the components that every run needs."""


def without_removed(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a config without the tables whose kind is "none".

    Raises
    ------
    ConfigError
        For a component that cannot be removed; it says what to write instead.
    """
    for role, instead in _WITHOUT.items():
        if isinstance(table.get(role), dict) and table[role].get("kind") == "none":
            raise ConfigError(f'{role}.kind = "none": {instead}')
    return _without_none(table)


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table without the sub-tables whose kind is "none"."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if not (isinstance(value, dict) and value.get("kind") == "none")
    }
