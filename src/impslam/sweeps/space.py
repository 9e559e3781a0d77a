"""What is searched: parameters of a config, each in a range or among some values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from impslam.sweeps.cases import plain


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers between two bounds; positive ones are searched by their logarithm."""

    low: float
    high: float
    whole: bool = False

    def suggest(self, trial: Any, key: str) -> str:
        """Return a value that the study wants to try."""
        if self.whole:
            return str(trial.suggest_int(key, int(self.low), int(self.high)))
        value = trial.suggest_float(key, self.low, self.high, log=self.low > 0.0)
        return f"{value:.4g}"

    def holds(self, value: Any) -> bool:
        """Tell whether a value lies within."""
        return isinstance(value, int | float) and self.low <= value <= self.high


@dataclass(frozen=True, slots=True)
class Choice:
    """Some values."""

    values: tuple[str, ...]

    def suggest(self, trial: Any, key: str) -> str:
        """Return a value that the study wants to try."""
        return str(trial.suggest_categorical(key, self.values))

    def holds(self, value: Any) -> bool:
        """Tell whether a value is one of them."""
        return value in map(plain, self.values)

    @property
    def low(self) -> str:
        """The first one."""
        return self.values[0]

    @property
    def high(self) -> str:
        """The last one."""
        return self.values[-1]


Space: TypeAlias = Mapping[str, Range | Choice]
"""By the key of the parameter."""
