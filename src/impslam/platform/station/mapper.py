"""Maps live messages, and drops whole scans rather than fall behind."""

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
from impslam.platform.station.continued_map import ContinuedMap
from impslam.platform.station.inbox import MAX_MESSAGES, MAX_SCANS, Inbox
from impslam.platform.station.map_store import FILE
from impslam.platform.station.mapper_status import OFF, MapperStatus, State, scans_text
from impslam.platform.station.stream_check import StreamCheck
from impslam.platform.station.warm_up import warm_up
from impslam.run import Run
from impslam.sources.ros_writers import base_topic
from impslam.types import Array, Message, TruePose

log = logging.getLogger(__name__)

ODOMETRY_TIMEOUT = 0.25
"""s that a scan waits for odometry up to its end; odometry comes every 10 ms, so it is lost by then."""
LOG_INTERVAL = 10.0  # s between log lines about dropped scans
SCAN_TIMEOUT = 10.0  # s that saving waits for the estimator to finish a scan
MAX_SCAN_GAP = 0.5
"""s without a scan after which the pose shown is dead-reckoned: five scans of a lidar at 10 Hz."""
DEAD_RECKONING_INTERVAL = 0.1  # s between dead-reckoned poses
MIN_SCANS_WITHOUT_ODOMETRY = 10
"""Scans without odometry before a notice: a second of a lidar at 10 Hz."""
LIVE = Path("live")
"""Replaces the log's name in a run folder."""


class LiveMapper:
    """Runs the estimator in its own thread on the messages that are put.

    Parameters
    ----------
    config : config of the run
    view : shows the map
    prepare : compiles the estimator of a config; called in the mapper's thread before the first scan
    """

    def __init__(
        self, config: Config, view: LiveView, prepare: Callable[[Config], None] = warm_up
    ) -> None:
        self._config, self._view, self._prepare = config, view, prepare
        self._lock = threading.Lock()
        self._mapping: LiveMap | None = None

    def warm_up(self) -> None:
        """Compile in the background, so that the first map does not have to wait."""
        threading.Thread(target=self._compile, name="warm-up", daemon=True).start()

    def _compile(self) -> None:
        try:
            self._prepare(self._config)
        except Exception as error:  # reported when mapping starts and fails again
            log.warning("the estimator cannot be compiled: %s", error)

    def start(self, continued: ContinuedMap | None = None) -> LiveMap | None:
        """End the present map; begin a new one with the robot at its origin, or continue one.

        Returns the map that has ended, None if there was none.

        Raises
        ------
        ImpError
            If the map cannot be continued; mapping of the present one then goes on.
        """
        with self._lock:
            before = self._mapping
            thread = None if before is None else before.thread
            begun = LiveMap(self._config, self._view, self._prepare, thread, continued)
            if before is not None:
                before.end()
            self._mapping = begun
            begun.thread.start()
            return before

    @property
    def continued(self) -> ContinuedMap | None:
        """The map that is continued or localised in, None if the map is a new one."""
        return None if self._mapping is None else self._mapping.continued

    def put(self, message: Message, arrived: float | None = None, stream: str = "") -> None:
        """Add a message, from any thread; never blocks.

        `arrived` is its arrival in host time, by default now; `stream` is by default the topic of its
        type.
        """
        mapping = self._mapping
        if mapping is not None and mapping.open:
            stream = stream or base_topic(type(message))
            mapping.put(message, now() if arrived is None else arrived, stream)

    def stop(self) -> None:
        """End mapping; the map can still be shown and saved."""
        with self._lock:
            if self._mapping is not None:
                self._mapping.end()
                self._mapping.wait()

    def save(self, folder: Path) -> Path:
        """Write a run folder of the present map, and return it; mapping goes on.

        A copy of the map is refined as at the end of a log. This takes a second or two in the caller's
        thread; scans wait only while the estimate is copied.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or the folder cannot be written.
        """
        refined, truth = self._present().draft()
        return write_run(folder, *refined(), truth)

    def save_map(self, folder: Path) -> Path:
        """Write only the map file, as `save` does; return its path.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or the file cannot be written.
        """
        return self._present().save(folder)

    def _present(self) -> LiveMap:
        mapping = self._mapping
        if mapping is None or mapping.run.scans == 0:
            raise ImpError("no map to save yet; start mapping and wait for a scan")
        return mapping

    def status(self) -> MapperStatus:
        """Return the status of mapping; never blocks."""
        return OFF if self._mapping is None else self._mapping.status()


class LiveMap:
    """One map, from its start to its end, and its thread."""

    def __init__(
        self,
        config: Config,
        view: LiveView,
        prepare: Callable[[Config], None],
        before: threading.Thread | None,
        continued: ContinuedMap | None,
    ) -> None:
        self._config = config if continued is None else continued.config
        self._view, self._prepare, self._previous = view, prepare, before
        self._truth, self.continued = TruthRecorder(), continued
        known = None if continued is None else continued.known
        self.run = Run(self._config, [self._truth, view], known)
        robot = self.run.robot
        robot.wait_for_rows_only()
        self._scan_types = tuple(sensor.consumes for sensor in robot.sensors.values())
        self._message_types = (*robot.streams.consumes, TruePose)
        kinds = (robot.odometry.consumes, *self._scan_types)
        robot.streams.choose({kind: base_topic(kind) for kind in kinds})  # as in a recording
        self._streams = StreamCheck(robot.streams)
        self._inbox: Inbox[tuple[str, Message]] = Inbox(MAX_SCANS * max(len(robot.sensors), 1))
        # `_busy` guards the run. A copier of the map holds `_next_turn` while it waits for `_busy`, so
        # that the estimator does not take it again at once.
        self._next_turn, self._busy = threading.Lock(), threading.Lock()
        self._compiled, self._ended, self._failure = False, False, ""
        self._progress = self._logged_at = float("-inf")  # monotonic
        self._logged_drops = self._order = 0
        self._notice_logged = False
        self._scanned_at = self._dead_reckoned_at = time.monotonic()
        self._newest = self._latency = float("nan")
        self.thread = threading.Thread(target=self._run_thread, name="mapper", daemon=True)

    @property
    def state(self) -> State:
        """Its state; see `MapperStatus`."""
        if self._failure:
            return "failed"
        if self._ended:
            return "off"
        return "running" if self._compiled else "compiling"

    @property
    def open(self) -> bool:
        """Whether messages are accepted."""
        return not (self._failure or self._ended)

    def put(self, message: Message, arrived: float, stream: str) -> None:
        """Add a message of a type and stream that the estimator uses; ignore others.

        The map begins when the estimator is ready: earlier odometry would only make the pose at the
        origin uncertain, which is certain by definition.
        """
        if not self._compiled or not isinstance(message, self._message_types):
            return
        if isinstance(message, TruePose) or self._streams.reads(type(message), stream):
            is_scan = isinstance(message, self._scan_types)
            room = self._inbox.put((stream, message), arrived, is_scan)
            if not room:
                self._fail(
                    f"the estimator has left {MAX_MESSAGES} messages waiting; start a new map"
                )

    def end(self) -> None:
        """Accept no more messages; the thread ends after its present scan."""
        self._ended = True
        self._inbox.wake()

    def wait(self) -> None:
        """Wait until an ended map has its last scan."""
        self.thread.join(2.0)

    def save(self, folder: Path) -> Path:
        """Write the map file to a folder, as `LiveMapper.save_map` does; return its path."""
        refined, _ = self.draft()
        known, _ = refined()
        return known.save(folder / FILE)

    def draft(self) -> tuple[Callable[[], tuple[Map, Outcome]], Array]:
        """Return a function that gives the present map and its run, and the true path.

        The copy is made between two scans.
        """
        with self._next_turn:
            if not self._busy.acquire(timeout=SCAN_TIMEOUT):
                raise ImpError(
                    "the estimator has been processing one scan for 10 s; stop mapping first"
                )
            try:
                return self.run.draft(LIVE), self._truth.path
            finally:
                self._busy.release()

    def status(self) -> MapperStatus:
        """Return the status of mapping; never blocks."""
        run, inbox = self.run, self._inbox
        return MapperStatus(
            self.state,
            run.scans,
            inbox.dropped,
            inbox.waiting,
            now() - self._newest,
            self._latency,
            self._failure
            or self._recently_dropped()
            or self._streams.notice()
            or self._missing_odometry()
            or run.odometry_notice,
            run.robot.problems.counts.get("scan", 0),
            name="" if self.continued is None else self.continued.name,
            frozen=self.continued is not None and self.continued.known.frozen,
            placed=self._view.snapshot().placed,
        )

    def _recently_dropped(self) -> str:
        recent = time.monotonic() - self._inbox.dropped_at < LOG_INTERVAL
        return self._drop_report() if recent else ""

    def _missing_odometry(self) -> str:
        """Return a notice if scans come without odometry, so that the robot seems stationary."""
        wanted = self.run.robot.odometry.consumes.__name__
        if self.run.scans < MIN_SCANS_WITHOUT_ODOMETRY or self.run.robot.counts.get(wanted):
            return ""
        return f"no {wanted} has come, the map is made without odometry; check the autopilot"

    def _drop_report(self) -> str:
        scans = scans_text(self._inbox.dropped)
        return f"{scans} dropped by now: this computer is too slow for the lidar"

    # ------------------------------------------------------------------ in the thread

    def _run_thread(self) -> None:
        try:
            if self._previous is not None:
                self._previous.join()  # it uses the same view
            new = self.continued is None
            self._view.begin(self.run, self._config.grid.resolution, placed=new)
            if not new:
                self._view.refresh()  # so that a hint can be given before the robot is located
            self._prepare(self._config)
            self._compiled = True
            while self.open:
                self._process_next()
                self._dead_reckon()
                self._log_drops()
                self._log_notice()
        except ImpError as error:
            self._fail(str(error))
        except Exception as error:  # the robot keeps running without a map
            log.debug("mapping failed", exc_info=True)
            self._fail(f"{type(error).__name__}: {error}; start a new map, and please report it")
        # Until a new map begins, the page would show the last pose as if it were the present one.
        self._view.end(
            f"mapping has {'failed' if self._failure else 'ended'}; the robot is not tracked"
        )

    def _fail(self, reason: str) -> None:
        if self.open:
            failure = " ".join(reason.split())
            log.error("mapping failed: %s", failure)
            self._failure = failure

    def _process_next(self) -> None:
        """Process one message, or the pending scans if their odometry does not come."""
        run = self.run
        taken = self._inbox.take(ODOMETRY_TIMEOUT)
        with self._next_turn:
            pass
        with self._busy:
            before = run.scans
            if not run.robot.pending:
                self._progress = time.monotonic()
            if taken is not None:
                self._feed(*taken[0], taken[1])
            if time.monotonic() - self._progress > ODOMETRY_TIMEOUT and self._inbox.empty:
                run.flush()
            if run.scans > before:
                self._newest = self._view.snapshot().arrived
                self._latency = now() - self._newest
                self._progress = self._scanned_at = time.monotonic()

    def _dead_reckon(self) -> None:
        """Show the dead-reckoned pose while no scan comes: the robot may still be driven."""
        moment = time.monotonic()
        silent = moment - self._scanned_at
        if (
            silent < MAX_SCAN_GAP
            or moment - self._dead_reckoned_at < DEAD_RECKONING_INTERVAL
            or self._inbox.waiting
        ):
            return
        if (path := self.run.dead_reckoned()) is not None:
            self._view.show_dead_reckoned(path, silent)
            self._dead_reckoned_at = moment

    def _feed(self, stream: str, message: Message, arrived: float) -> None:
        if isinstance(message, self._scan_types):
            self._view.expect(message.stamp, arrived)
        self.run.feed(single_row(stream, message, self._order))
        self._order += 1

    def _log_drops(self) -> None:
        """Log the number of dropped scans, at most once per `LOG_INTERVAL`."""
        dropped, moment = self._inbox.dropped, time.monotonic()
        if dropped > self._logged_drops and moment - self._logged_at >= LOG_INTERVAL:
            log.warning("%s", self._drop_report())
            self._logged_drops, self._logged_at = dropped, moment

    def _log_notice(self) -> None:
        """Log once that lengths measured by odometry differ from the config."""
        if self.run.odometry_notice and not self._notice_logged:
            log.warning("%s", self.run.odometry_notice)
            self._notice_logged = True
