"""Search space from command options: named parameters, or by default all noise of a config."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from impslam.component import build
from impslam.config import Config
from impslam.errors import ConfigError
from impslam.sweeps.cases import alternatives, plain
from impslam.sweeps.space import Choice, Range

NOISE_FACTOR = 10.0
"""Noise is searched between the configured value divided and multiplied by this."""


def parse_space(searches: Sequence[str], config: Config) -> dict[str, Range | Choice]:
    """Return the space of "key=low:high" and "key=a,b,c"; without any, that of all noise.

    Raises
    ------
    ConfigError
        If one is not of this form, or there is nothing to search.
    """
    if not searches:
        return noise_space(config)
    space: dict[str, Range | Choice] = {}
    for key, values in alternatives(searches).items():
        if len(values) == 1 and ":" in values[0]:
            low, high = map(plain, values[0].split(":", 1))
            space[key] = _range(key, low, high, config)
        elif len(values) > 1:
            space[key] = Choice(tuple(values))
        else:
            raise ConfigError(
                f"--search {key}={values[0]}: expected LOW:HIGH or values, e.g. {key}=0.01:0.1"
            )
    return space


def _range(key: str, low: Any, high: Any, config: Config) -> Range:
    if not (_is_number(low) and _is_number(high) and low < high):
        raise ConfigError(f"--search {key}={low}:{high}: expected two numbers, the lower one first")
    return Range(low, high, isinstance(value_of(config.resolved(), key), int))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def noise_space(config: Config) -> dict[str, Range | Choice]:
    """Return ranges of all standard deviations of odometry and sensors that are not 0."""
    found = dict(_noise("odometry", build("odometry", config.odometry)))
    for name, table in config.sensors.items():
        plain_table = {key: value for key, value in table.items() if key != "extractors"}
        found |= _noise(f"sensors.{name}", build("sensor", plain_table))
    space = {
        key: Range(float(f"{value / NOISE_FACTOR:.4g}"), float(f"{value * NOISE_FACTOR:.4g}"))
        for key, value in found.items()
        if value
    }
    if not space:
        raise ConfigError(
            "the config has no noise to search; name parameters with --search KEY=LOW:HIGH"
        )
    return dict(space)


def _noise(where: str, part: BaseModel) -> Iterator[tuple[str, float]]:
    """Yield the keys and values of the standard deviations of a component."""
    for name, field in type(part).model_fields.items():
        value, extra = getattr(part, name), field.json_schema_extra
        if isinstance(value, BaseModel):
            yield from _noise(f"{where}.{name}", value)
        elif isinstance(extra, dict) and extra.get("noise"):
            yield f"{where}.{name}", value


def value_of(table: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key in a config's table; None if it is missing."""
    value: Any = table
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value
