"""Plays a log through the estimator as if it happened now: pause, step, speed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from impslam.config import Config
from impslam.observers.base import Observer, Outcome
from impslam.observers.live_view import LiveView
from impslam.sources.base import Source

State: TypeAlias = Literal[
    "ready", "compiling", "playing", "paused", "writing", "ended", "stopped", "failed"
]


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """Where a replay is.

    Attributes
    ----------
    state : "ready" (not started), "compiling" (first run on a machine), "playing", "paused",
        "writing" (the log is over, the run folder is being written), "ended", "stopped" (early, by
        request), "failed"
    position, total : how far in the log, in its own unit (messages or bytes); total None if unknown
    stamp : s, the log's, of the newest scan played, NaN before the first
    seconds : s of log played, gaps that were skipped left out
    speed : s of log in a second, inf: as fast as possible
    steps : scans mapped
    skipped : s of log skipped in gaps
    detail : one line: why it failed, or the last gap or jump that was skipped; "" where all is well
    """

    state: State
    position: int
    total: int | None
    stamp: float
    seconds: float
    speed: float
    steps: int
    skipped: float
    detail: str


class Player:
    """Runs a log through the estimator in a thread of its own, at the pace of its stamps.

    Parameters
    ----------
    config : what is estimated, and how
    source : the log
    observers : what else looks at the run, e.g. what writes the run folder
    view : what shows the map
    """

    def __init__(
        self, config: Config, source: Source, observers: Iterable[Observer], view: LiveView
    ) -> None:
        self._config, self._source, self._view = config, source, view
        self._observers = list(observers)

    def start(self) -> None:
        """Begin to play."""
        raise NotImplementedError

    def pause(self) -> None:
        """Halt before the next scan."""
        raise NotImplementedError

    def resume(self) -> None:
        """Go on."""
        raise NotImplementedError

    def step(self) -> None:
        """Play one scan and halt."""
        raise NotImplementedError

    def set_speed(self, speed: float) -> None:
        """Play `speed` s of log in a second, 0.1 to 100, or inf: as fast as possible.

        Raises
        ------
        ImpError
            If it is another number.
        """
        raise NotImplementedError

    def stop(self) -> None:
        """End early; observers are not told an outcome, so no run folder of half a log is made."""
        raise NotImplementedError

    def wait(self, timeout: float | None = None) -> Outcome | None:
        """Wait for the end; return what the run was, None if stopped or not yet over.

        Raises
        ------
        ImpError
            What made it fail.
        """
        raise NotImplementedError

    def status(self) -> PlayerStatus:
        """Return where the replay is; never blocks."""
        raise NotImplementedError


def play_live(
    config: Config, source: Source, observers: Iterable[Observer], view: LiveView
) -> Player:
    """Start to replay a log and return its player."""
    player = Player(config, source, observers, view)
    player.start()
    return player
