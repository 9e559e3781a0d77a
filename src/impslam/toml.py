"""Parse TOML from untrusted sources; errors are one line."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from impslam.errors import ConfigError

MAX_DEPTH = 32
"""Levels of tables and lists; a config has 5, and functions on tables are recursive."""


class TomlSyntaxError(ConfigError):
    """The text is not TOML."""


def parse(text: str, where: str) -> dict[str, Any]:
    """Return the table of a TOML text; `where` names the text in errors.

    Raises
    ------
    TomlSyntaxError
        If it is not TOML.
    ConfigError
        If it is nested too deeply, or contains a number of thousands of digits.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlSyntaxError(f"{where}: not valid TOML: {error}") from None
    except RecursionError:
        raise _too_deep(where) from None
    except ValueError:  # Python limits the digits of an integer
        raise ConfigError(f"{where}: contains a number with too many digits; shorten it") from None
    level: list[Any] = [table]
    for _ in range(MAX_DEPTH):
        level = [part for parts in level for part in _parts(parts)]
    if level:
        raise _too_deep(where)
    return table


def _parts(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def _too_deep(where: str) -> ConfigError:
    return ConfigError(
        f"{where}: is nested too deeply; no table needs more than {MAX_DEPTH} levels"
    )
