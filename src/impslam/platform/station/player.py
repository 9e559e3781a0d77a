"""Replays a log through the estimator in real time, with pause, step and speed."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from impslam.columns import Batch
from impslam.config import Config
from impslam.errors import ImpError, QuitError, in_a_line
from impslam.health import NO_FAULT, LogFault
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

STOP_TIMEOUT = 5.0  # s to finish the present scan
WRITE_TIMEOUT = 120.0  # s to write the run folder of a log that was played to its end


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """The status of a replay.

    Attributes
    ----------
    state : "ready" (not started), "compiling" (first run on a machine), "playing", "paused",
        "writing" (the log is over, the run folder is being written), "ended", "stopped" (early, by
        request), "failed"
    position, total : in the log, in its own unit (messages or bytes); total None if unknown
    stamp : log time of the newest scan played, s, NaN before the first
    seconds : s of log played, without skipped gaps
    speed : s of log per second, inf: as fast as possible
    steps : scans mapped
    skipped : s of log skipped in gaps
    detail : one line: why it failed, or the last gap or jump skipped; "" if all is well
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
    """Runs a log through the estimator in its own thread, at the pace of its stamps.

    The pace only decides when a scan is read, so a run at any pace gives the same files. Scans set the
    pace; messages between them are read with the scan after them.

    Parameters
    ----------
    config : config of the run
    source : the log
    observers : further observers of the run, e.g. of the run folder
    view : shows the map
    prepare : compiles the estimator of a config
    fault : of the whole log, which affects all poses
    """

    def __init__(
        self,
        config: Config,
        source: Source,
        observers: Iterable[Observer],
        view: LiveView,
        prepare: Callable[[Config], None] = warm_up,
        fault: LogFault = NO_FAULT,
    ) -> None:
        self._config, self._source, self._view, self._prepare = config, source, view, prepare
        self._run = Run(config, [view, *observers], fault=fault)
        sensors = self._run.robot.sensors.values()
        self._scan_types = tuple(sensor.consumes for sensor in sensors)
        self._pace = Pace()
        self._phase: State = "ready"
        self._position: tuple[int, int | None] = 0, None
        self._seek_target = math.inf  # position up to which it plays unpaced, inf: no seek
        self._map: Map | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run_thread, name="player", daemon=True)

    def start(self) -> None:
        """Begin to play; earlier calls of `pause` and `set_speed` apply."""
        self._phase = "compiling"
        self._thread.start()

    def pause(self) -> None:
        """Halt before the next scan."""
        self._pace.pause()

    def resume(self) -> None:
        """Resume."""
        self._pace.resume()

    def step(self) -> None:
        """Play one scan, then pause."""
        self._pace.step()

    def set_speed(self, speed: float) -> None:
        """Play `speed` s of log per second, 0.1 to 100, or inf: as fast as possible.

        Raises
        ------
        ImpError
            If it is out of range.
        """
        self._pace.set_speed(speed)

    def seek(self, share: float) -> None:
        """Play as fast as possible up to a share of the log, 0 to 1; then play or pause as before.

        Raises
        ------
        ImpError
            If it is behind the present position, or the length of the log is unknown.
        """
        position, total = self._position
        if not total:
            begun = self._phase not in {"ready", "compiling"}
            advice = "play it as fast as possible" if begun else "wait until it plays"
            raise ImpError(f"the length of this log is not known yet; {advice}")
        if share * total < position:
            raise ImpError(
                "a replay cannot go back, because scans cannot be removed from the map; start it again"
            )
        self._seek_target = share * total
        self._pace.set_unpaced(True)

    def stop(self) -> None:
        """End early; observers finish with the map up to now, so that a run folder is written."""
        self._pace.stop()
        if self._phase == "compiling":  # there is no map yet, and the thread ends before it plays
            return
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT)
        if self._phase == "writing":  # half a folder would stay
            self._thread.join(WRITE_TIMEOUT)

    def wait(self, timeout: float | None = None) -> Map | None:
        """Wait for the end; return the map, None if the replay is not over.

        Raises
        ------
        QuitError
            If it was stopped before the end of the log.
        ImpError
            The error that made it fail.
        """
        self._thread.join(timeout)
        if self._error is not None:
            raise self._error
        return self._map

    def status(self) -> PlayerStatus:
        """Return the status of the replay; never blocks."""
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

    def _run_thread(self) -> None:
        try:
            self._view.begin(self._run, self._config.grid.resolution)
            self._prepare(self._config)
            self._phase = "playing"
            self._play()
            self._phase = "ended"
        except QuitError as error:
            self._error, self._phase = error, "stopped"
        except Exception as error:  # raised by `wait`
            self._error, self._phase = error, "failed"

    def _play(self) -> None:
        with self._source as source, self._run.salvaging(source):
            for batch in self._run.robot.streams.read(source, rows=1):
                if not self._wait_until_due(batch):
                    self._phase = "writing"
                    raise QuitError("the replay was stopped before the end of the log")
                before = self._run.scans
                self._run.feed(batch)
                if self._run.scans > before:
                    self._pace.played(self._run.scans - before)
            self._run.flush()
            self._position = source.position, source.total
        self._phase = "writing"
        self._map = self._run.finish(self._source)

    def _wait_until_due(self, batch: Batch) -> bool:
        """Wait until a row is due; return whether to continue."""
        (columns,) = batch.values()
        if not issubclass(columns.kind, self._scan_types):
            return True
        stamp = float(columns.stamps[0])
        self._position = self._source.position, self._source.total
        if self._source.position >= self._seek_target:
            self._seek_target = math.inf
            self._pace.set_unpaced(False)
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
    fault: LogFault = NO_FAULT,
) -> Player:
    """Start the replay of a log and return its `Player`."""
    player = Player(config, source, observers, view, fault=fault)
    player.start()
    return player
