"""Maps what live sources send, and drops whole scans rather than fall behind."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

from impslam.columns import single_row
from impslam.config import Config
from impslam.errors import ImpError
from impslam.map import Map
from impslam.observers.base import Outcome
from impslam.observers.live_view import LiveView
from impslam.observers.recorder import TruthRecorder
from impslam.observers.run_folder import write_run
from impslam.platform.devices.base import now
from impslam.platform.station.going_on import GoingOn
from impslam.platform.station.inbox import LIMIT, Inbox
from impslam.platform.station.map_store import FILE
from impslam.platform.station.mapper_status import OFF, MapperStatus, State
from impslam.platform.station.warm_up import warm_up
from impslam.run import Run
from impslam.types import Array, Message, TruePose

log = logging.getLogger(__name__)

PATIENCE = 0.25
"""s that a scan waits for odometry to reach its end; it comes every 10 ms, and is lost by then."""
NEWS = 10.0  # s between two lines in the log on scans that were dropped
ANSWER = 10.0  # s until the estimator must have come to the end of a scan for the map to be saved
SILENT = 0.5
"""s without a scan after which the pose shown is dead-reckoned: five scans of a lidar at 10 Hz."""
CARRY = 0.1  # s between two such poses
BLIND = 10  # scans without odometry until it is told: a second of a lidar at 10 Hz
LIVE = Path("live")
"""What stands in a run folder for the log's name."""


class LiveMapper:
    """Runs the estimator in a thread of its own on messages that others put.

    Parameters
    ----------
    config : what is estimated, and how
    view : what shows the map
    prepare : compiles the estimator of a config; called in the mapper's thread before the first scan
    """

    def __init__(
        self, config: Config, view: LiveView, prepare: Callable[[Config], None] = warm_up
    ) -> None:
        self._config, self._view, self._prepare = config, view, prepare
        self._lock = threading.Lock()
        self._mapping: _Mapping | None = None

    def warm_up(self) -> None:
        """Compile in the background; called at a program's start, the first map need not wait."""
        threading.Thread(target=self._compile, name="warm-up", daemon=True).start()

    def _compile(self) -> None:
        try:
            self._prepare(self._config)
        except Exception as error:  # it is told when mapping starts, and fails again
            log.warning("the estimator cannot be compiled: %s", error)

    def start(self, going_on: GoingOn | None = None) -> None:
        """Begin a new map, the robot standing at its origin, or go on with one; give up the present one.

        Raises
        ------
        ImpError
            If the map cannot be gone on with; the present one goes on.
        """
        with self._lock:
            before = self._mapping
            thread = None if before is None else before.thread
            begun = _Mapping(self._config, self._view, self._prepare, thread, going_on)
            if before is not None:
                before.end()
            self._mapping = begun
            begun.thread.start()

    @property
    def going_on(self) -> GoingOn | None:
        """The map that is gone on with or localised in, None where the map is a new one."""
        return None if self._mapping is None else self._mapping.going_on

    def put(self, message: Message, arrived: float | None = None) -> None:
        """Take a message from any thread; never blocks.

        `arrived` is the host time at which it came, now if it is not given.
        """
        mapping = self._mapping
        if mapping is not None and mapping.open:
            mapping.put(message, now() if arrived is None else arrived)

    def stop(self) -> None:
        """End mapping; the map stays to be seen and saved."""
        with self._lock:
            if self._mapping is not None:
                self._mapping.end()
                self._mapping.thread.join(2.0)

    def save(self, folder: Path) -> Path:
        """Write a run folder of what is mapped by now, and return it; mapping goes on.

        The map is settled as at the end of a log; the one that is shown and driven by stays as it is.
        It takes a second or two, in the caller's thread; scans wait only while the estimate is copied.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or the folder cannot be written to.
        """
        settled, truth = self._draft()
        return write_run(folder, *settled(), truth)

    def save_map(self, folder: Path) -> Path:
        """Write the map alone, as `save` does; return its path.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or the file cannot be written.
        """
        settled, _ = self._draft()
        known, _ = settled()
        return known.save(folder / FILE)

    def _draft(self) -> tuple[Callable[[], tuple[Map, Outcome]], Array]:
        mapping = self._mapping
        if mapping is None or mapping.run.scans == 0:
            raise ImpError("there is no map to save yet; start mapping and wait for a scan")
        return mapping.draft()

    def status(self) -> MapperStatus:
        """Return how mapping is doing; never blocks."""
        return OFF if self._mapping is None else self._mapping.status()


class _Mapping:
    """One map, from its start to its end, and the thread that makes it."""

    def __init__(
        self,
        config: Config,
        view: LiveView,
        prepare: Callable[[Config], None],
        before: threading.Thread | None,
        going_on: GoingOn | None,
    ) -> None:
        self._config = config if going_on is None else going_on.config
        self._view, self._prepare, self._before = view, prepare, before
        self._truth, self.going_on = TruthRecorder(), going_on
        known = None if going_on is None else going_on.known
        self.run = Run(self._config, [self._truth, view], known)
        robot = self.run.robot
        self._scans = tuple(sensor.consumes for sensor in robot.sensors.values())
        self._wanted = (*robot.streams.consumes, TruePose)
        self._inbox = Inbox()
        # Who copies the map takes the door first, so that the estimator lets them in.
        self._door, self._between = threading.Lock(), threading.Lock()
        self._compiled, self._ended, self._failure = False, False, ""
        self._progress = self._news = float("-inf")  # monotonic
        self._told = self._order = 0
        self._noticed = False
        self._stepped = self._carried = time.monotonic()
        self._newest = self._latency = float("nan")
        self.thread = threading.Thread(target=self._work, name="mapper", daemon=True)

    @property
    def state(self) -> State:
        if self._failure:
            return "failed"
        if self._ended:
            return "off"
        return "running" if self._compiled else "compiling"

    @property
    def open(self) -> bool:
        """Tell whether messages are taken."""
        return not (self._failure or self._ended)

    def put(self, message: Message, arrived: float) -> None:
        """Take what the estimator understands; the rest costs this test.

        The map begins when the estimator is ready: what the wheels feel before that would only make
        the pose at its origin, which is certain by definition, uncertain.
        """
        if self._compiled and isinstance(message, self._wanted):
            room = self._inbox.put(message, arrived, isinstance(message, self._scans))
            if not room:
                self._fail(f"the estimator has left {LIMIT} messages waiting; start a new map")

    def end(self) -> None:
        """Take no more messages; the thread ends after the scan it is at."""
        self._ended = True
        self._inbox.wake()

    def draft(self) -> tuple[Callable[[], tuple[Map, Outcome]], Array]:
        """Return, between two scans, what gives the map and its run as of now; and the true path."""
        with self._door:
            if not self._between.acquire(timeout=ANSWER):
                raise ImpError("the estimator has been at one scan for 10 s; stop mapping first")
            try:
                return self.run.draft(LIVE), self._truth.path
            finally:
                self._between.release()

    def status(self) -> MapperStatus:
        run, inbox = self.run, self._inbox
        return MapperStatus(
            self.state,
            run.scans,
            inbox.dropped,
            inbox.waiting,
            now() - self._newest,
            self._latency,
            self._failure or self._of_late() or self._without_motion() or run.odometry_notice,
            run.robot.problems.counts.get("scan", 0),
            *(("", False) if self.going_on is None else self.going_on.told),
            placed=self._view.snapshot().placed,
        )

    def _of_late(self) -> str:
        recent = time.monotonic() - self._inbox.dropped_at < NEWS
        return self._dropped() if recent else ""

    def _without_motion(self) -> str:
        """Return what a map lacks where scans come and odometry does not: drives look like stands."""
        wanted = self.run.robot.odometry.consumes.__name__
        if self.run.scans < BLIND or self.run.robot.counts.get(wanted):
            return ""
        return f"no {wanted} has come, the map is made without odometry; check the autopilot"

    def _dropped(self) -> str:
        return (
            f"{self._inbox.dropped} scans dropped by now: this computer is too slow for the lidar"
        )

    # ------------------------------------------------------------------ in the thread

    def _work(self) -> None:
        try:
            if self._before is not None:
                self._before.join()  # it shows its map in the same view
            new = self.going_on is None
            self._view.begin(self.run, self._config.grid.resolution, placed=new)
            if not new:
                self._view.refresh()  # to be seen, and pointed at, before the robot is found in it
            self._prepare(self._config)
            self._compiled = True
            while self.open:
                self._next()
                self._carry()
                self._tell_dropped()
                self._tell_notice()
        except ImpError as error:
            self._fail(str(error))
        except Exception as error:  # the robot goes on without a map
            log.debug("mapping failed", exc_info=True)
            self._fail(f"{type(error).__name__}: {error}; start a new map, and please report it")

    def _fail(self, reason: str) -> None:
        if self.open:
            failure = " ".join(reason.split())
            log.error("mapping failed: %s", failure)
            self._failure = failure

    def _next(self) -> None:
        """Take in one message, or use the scans whose odometry does not come."""
        run = self.run
        taken = self._inbox.take(PATIENCE)
        with self._door:
            pass
        with self._between:
            before = run.scans
            if not run.robot.pending:
                self._progress = time.monotonic()
            if taken is not None:
                self._feed(*taken)
            if time.monotonic() - self._progress > PATIENCE and self._inbox.empty:
                run.flush()
            if run.scans > before:
                self._newest = self._view.snapshot().arrived
                self._latency = now() - self._newest
                self._progress = self._stepped = time.monotonic()

    def _carry(self) -> None:
        """Show where the robot is though no scan comes: it may be driven on."""
        moment = time.monotonic()
        silent = moment - self._stepped
        if silent < SILENT or moment - self._carried < CARRY or self._inbox.waiting:
            return
        if (path := self.run.dead_reckoned()) is not None:
            self._view.show_dead_reckoned(path, silent)
            self._carried = moment

    def _feed(self, message: Message, arrived: float) -> None:
        if isinstance(message, self._scans):
            self._view.expect(message.stamp, arrived)
        self.run.feed(single_row(type(message).__name__, message, self._order))
        self._order += 1

    def _tell_dropped(self) -> None:
        """Log what was dropped, in a line now and then."""
        dropped, moment = self._inbox.dropped, time.monotonic()
        if dropped > self._told and moment - self._news >= NEWS:
            log.warning("%s", self._dropped())
            self._told, self._news = dropped, moment

    def _tell_notice(self) -> None:
        """Log once that odometry's lengths are not those of the config."""
        if self.run.odometry_notice and not self._noticed:
            log.warning("%s", self.run.odometry_notice)
            self._noticed = True
