"""Maps what live sources send, and drops whole scans rather than fall behind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from impslam.config import Config
from impslam.observers.live_view import LiveView
from impslam.types import Message

State: TypeAlias = Literal["off", "compiling", "running", "failed"]


@dataclass(frozen=True, slots=True)
class MapperStatus:
    """How mapping is doing.

    Attributes
    ----------
    state : "off" (never started, or stopped), "compiling" (before the first scan; a minute at worst,
        on a fresh machine only), "running", or "failed"
    steps : scans mapped
    dropped_scans : scans that came too fast to be mapped, or while it was compiling
    waiting : scans that wait to be mapped
    behind : s since the newest mapped scan arrived, NaN before the first; one sweep when all is well
    latency : s from the newest mapped scan's arrival to its being mapped, NaN before the first
    detail : one line: why it failed, what was dropped; "" where all is well
    """

    state: State
    steps: int
    dropped_scans: int
    waiting: int
    behind: float
    latency: float
    detail: str


class LiveMapper:
    """Runs the estimator in a thread of its own on messages that others put.

    Parameters
    ----------
    config : what is estimated, and how
    view : what shows the map
    """

    def __init__(self, config: Config, view: LiveView) -> None:
        self._config, self._view = config, view

    def start(self) -> None:
        """Begin a new map, the robot standing at its origin; an older one is given up."""
        raise NotImplementedError

    def put(self, message: Message, arrived: float | None = None) -> None:
        """Take a message from any thread; never blocks.

        `arrived` is the host time at which it came, now if it is not given.
        """
        raise NotImplementedError

    def stop(self) -> None:
        """End mapping; the map stays to be seen and saved."""
        raise NotImplementedError

    def save(self, folder: Path) -> Path:
        """Write a run folder of what is mapped by now, and return it; mapping goes on.

        It takes a second or two, in the caller's thread.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or the folder cannot be written to.
        """
        raise NotImplementedError

    def status(self) -> MapperStatus:
        """Return how mapping is doing; never blocks."""
        return MapperStatus("off", 0, 0, 0, float("nan"), float("nan"), "")
