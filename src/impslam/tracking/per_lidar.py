"""State of each lidar, reset if the number of its beams changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

State = TypeVar("State")


class PerLidar(Generic[State]):
    """The states of lidars by their names; `make` returns a new one for a number of beams."""

    def __init__(self, make: Callable[[int], State]) -> None:
        self._make = make
        self._states: dict[str, tuple[int, State]] = {}

    def get(self, sensor: str, beams: int) -> State:
        """Return the state of a lidar; only its own scans are compared with each other."""
        known = self._states.get(sensor)
        if known is None or known[0] != beams:
            known = self._states[sensor] = beams, self._make(beams)
        return known[1]
