"""TOML from anywhere, as a table; whatever is wrong with it is told in one line."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from impslam.errors import ConfigError

DEEPEST = 32
"""Levels of tables and lists; a config has 5, and what walks a table calls itself at each level."""


class SyntaxFault(ConfigError):
    """A text that is not TOML."""


def parse(text: str, where: str) -> dict[str, Any]:
    """Return the table that a text holds; `where` names the text in errors.

    Raises
    ------
    SyntaxFault
        If it is not TOML.
    ConfigError
        If it is beyond what can be read: nested too deeply, or a number of thousands of digits.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SyntaxFault(f"{where}: not valid TOML: {error}") from None
    except RecursionError:
        raise _too_deep(where) from None
    except ValueError:  # Python limits the digits of an integer
        raise ConfigError(f"{where}: holds a number of too many digits; shorten it") from None
    level: list[Any] = [table]
    for _ in range(DEEPEST):
        level = [part for parts in level for part in _parts(parts)]
    if level:
        raise _too_deep(where)
    return table


def _parts(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def _too_deep(where: str) -> ConfigError:
    return ConfigError(f"{where}: is nested too deeply; no table needs more than {DEEPEST} levels")
