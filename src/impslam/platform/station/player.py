"""Plays a log through the estimator as if it happened now: pause, step, speed."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from impslam.columns import Batch
from impslam.config import Config
from impslam.errors import ImpError, QuitError, in_a_line
from impslam.health import SOUND, Standing
from impslam.map import Map
from impslam.observers.base import Observer
from impslam.observers.live_view import LiveView
from impslam.platform.devices.base import now
from impslam.platform.station.pace import Pace
from impslam.platform.station.warm_up import warm_up
from impslam.run import Run
from impslam.sources.base import Source

State: TypeAlias = Literal[
    "ready", "compiling", "playing", "paused", "writing", "ended", "stopped", "failed"
]

STOP = 5.0  # s to end the scan at work
WRITE = 120.0  # s to write the run folder of a log that was played to its end


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

    A run at any pace gives the same files as one without: the pace says when a scan is read, and
    nothing else. Scans set the pace; what lies between them is read with the scan after it.

    Parameters
    ----------
    config : what is estimated, and how
    source : the log
    observers : what else looks at the run, e.g. what writes the run folder
    view : what shows the map
    prepare : compiles the estimator of a config
    health : what is wrong with the log throughout
    """

    def __init__(
        self,
        config: Config,
        source: Source,
        observers: Iterable[Observer],
        view: LiveView,
        prepare: Callable[[Config], None] = warm_up,
        health: Standing = SOUND,
    ) -> None:
        self._config, self._source, self._view, self._prepare = config, source, view, prepare
        self._run = Run(config, [view, *observers], health=health)
        sensors = self._run.robot.sensors.values()
        self._scans = tuple(sensor.consumes for sensor in sensors)
        self._pace = Pace()
        self._phase: State = "ready"
        self._position: tuple[int, int | None] = 0, None
        self._goal = math.inf  # position to which it plays as fast as possible, inf: nowhere
        self._map: Map | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="player", daemon=True)

    def start(self) -> None:
        """Begin to play; what `pause` and `set_speed` said before holds."""
        self._phase = "compiling"
        self._thread.start()

    def pause(self) -> None:
        """Halt before the next scan."""
        self._pace.pause()

    def resume(self) -> None:
        """Go on."""
        self._pace.resume()

    def step(self) -> None:
        """Play one scan and halt."""
        self._pace.step()

    def set_speed(self, speed: float) -> None:
        """Play `speed` s of log in a second, 0.1 to 100, or inf: as fast as possible.

        Raises
        ------
        ImpError
            If it is another number.
        """
        self._pace.set_speed(speed)

    def seek(self, share: float) -> None:
        """Play as fast as possible to a share of the log, 0 to 1, then on, or halt, as before.

        Raises
        ------
        ImpError
            If it lies behind, or the log does not tell how long it is.
        """
        position, total = self._position
        if not total:
            raise ImpError("how long this log is, is not known yet; play it as fast as possible")
        if share * total < position:
            raise ImpError("a replay cannot go back, for a map does not forget; start it again")
        self._goal = share * total
        self._pace.rush(True)

    def stop(self) -> None:
        """End early; observers are told what is known by then, so a run folder holds it."""
        self._pace.stop()
        if self._thread.is_alive():
            self._thread.join(STOP)
        if self._phase == "writing":  # half a folder would stay
            self._thread.join(WRITE)

    def wait(self, timeout: float | None = None) -> Map | None:
        """Wait for the end; return the map, None if it is not yet over.

        Raises
        ------
        QuitError
            If it was stopped before the end of the log.
        ImpError
            What made it fail.
        """
        self._thread.join(timeout)
        if self._error is not None:
            raise self._error
        return self._map

    def status(self) -> PlayerStatus:
        """Return where the replay is; never blocks."""
        stamp, seconds, skipped, note = self._pace.place
        state: State = self._phase
        if state == "playing" and self._pace.paused:
            state = "paused"
        failed = None if state == "stopped" else self._error
        detail = note if failed is None else in_a_line(failed)
        return PlayerStatus(
            state,
            *self._position,
            stamp,
            seconds,
            self._pace.speed,
            self._run.scans,
            skipped,
            detail,
        )

    def _work(self) -> None:
        try:
            self._view.begin(self._run, self._config.grid.resolution)
            self._prepare(self._config)
            self._phase = "playing"
            self._play()
            self._phase = "ended"
        except QuitError as error:
            self._error, self._phase = error, "stopped"
        except Exception as error:  # who waits for the end gets it
            self._error, self._phase = error, "failed"

    def _play(self) -> None:
        with self._source as source, self._run.salvaging(source):
            for batch in source.batches(rows=1):
                if not self._admits(batch):
                    self._phase = "writing"
                    raise QuitError("the replay was stopped before the end of the log")
                before = self._run.scans
                self._run.feed(batch)
                if self._run.scans > before:
                    self._pace.stepped(self._run.scans - before)
            self._run.flush()
            self._position = source.position, source.total
        self._phase = "writing"
        self._map = self._run.finish(self._source)

    def _admits(self, batch: Batch) -> bool:
        """Wait until it is time for a row; tell whether to go on."""
        (columns,) = batch.values()
        if not issubclass(columns.kind, self._scans):
            return True
        stamp = float(columns.stamps[0])
        self._position = self._source.position, self._source.total
        if self._source.position >= self._goal:
            self._goal = math.inf
            self._pace.rush(False)
        verdict = self._pace.wait(stamp)
        while verdict == "halted":
            self._view.refresh()
            verdict = self._pace.wait(stamp)
        self._view.expect(stamp, now())
        return verdict == "go"


def play_live(
    config: Config,
    source: Source,
    observers: Iterable[Observer],
    view: LiveView,
    health: Standing = SOUND,
) -> Player:
    """Start to replay a log and return its player; see `Player`."""
    player = Player(config, source, observers, view, health=health)
    player.start()
    return player
