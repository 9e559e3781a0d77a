"""Search space: parameters of a config, each with a range or a list of values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from impslam.sweeps.cases import plain

ROUNDING = 5e-4
"""Rounding of a suggested value, relative to itself and to its range: what four digits cause."""


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers between two bounds; positive ones are searched on a logarithmic scale."""

    low: float
    high: float
    whole: bool = False

    def suggest(self, trial: Any, key: str) -> str:
        """Return the value suggested by a trial."""
        is_log = self.low > 0.0
        if self.whole:
            return str(trial.suggest_int(key, int(self.low), int(self.high), log=is_log))
        return self._rounded(trial.suggest_float(key, self.low, self.high, log=is_log))

    def _rounded(self, value: float) -> str:
        """Return a value with no more digits than matter in the range, and inside it."""
        tolerance = ROUNDING * min(abs(value), self.high - self.low)
        for digits in range(1, 17):
            text = f"{value:.{digits}g}"
            if abs(float(text) - value) <= tolerance and self.contains(float(text)):
                return text
        return repr(value)

    def contains(self, value: Any) -> bool:
        """Return whether a value is within the range."""
        return isinstance(value, int | float) and self.low <= value <= self.high

    def suggestion(self, value: Any) -> Any:
        """Return what a trial suggests for a value of the config; None if it is outside."""
        return value if self.contains(value) else None


@dataclass(frozen=True, slots=True)
class Choice:
    """A list of values."""

    values: tuple[str, ...]

    def suggest(self, trial: Any, key: str) -> str:
        """Return the value suggested by a trial."""
        return str(trial.suggest_categorical(key, self.values))

    def suggestion(self, value: Any) -> Any:
        """Return what a trial suggests for a value of the config; None if it is not in the list."""
        return next((text for text in self.values if plain(text) == value), None)

    @property
    def low(self) -> str:
        """The first value."""
        return self.values[0]

    @property
    def high(self) -> str:
        """The last value."""
        return self.values[-1]


Space: TypeAlias = Mapping[str, Range | Choice]
"""Ranges and choices by the key of the parameter."""
