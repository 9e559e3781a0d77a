"""The main loop: from a log source to a map.

The robot turns batches of columns into motions and sweeps, the tracker turns these into tracks, and the
estimator revises the map at each keyframe. Observers receive tracks and revisions.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from impslam.bookkeeping import Stopwatch, about, dropped, seal
from impslam.columns import Batch, Motions, Sweeps, batches
from impslam.config import Config
from impslam.continuing import Continuation, KnownMap, begin_with, refuse_earlier
from impslam.diagnosis.diagnose import find_log_fault
from impslam.diagnosis.odometry_watch import OdometryWatch
from impslam.errors import Interrupted, SourceError, in_a_line
from impslam.estimators.base import Draft, completed
from impslam.geometry.se2 import compose, compose_uncertain
from impslam.health import CHANGED, NO_FAULT, UNEXPLAINED, LogFault, silent_time
from impslam.map import Keyframe, Keyframes, Map, PathRows, T_map_odom, Track
from impslam.map_builder import MapBuilder, blended
from impslam.observers.base import Dropped, Observer, Outcome, checked_observers, finish_all
from impslam.observers.health import HealthMonitor
from impslam.open_log import for_continuing, open_log
from impslam.provenance import fingerprint
from impslam.sources.base import Problems, Source
from impslam.threads import OneBlasThread
from impslam.types import Array, Edges, Landmark, Message, TruePose

Progress = Callable[[int, int | None], None]
"""Called with the position in the log and the length of the log, or None if the length is unknown."""


def run(  # noqa: PLR0913  # each is a choice that a user may make
    log: str | Path,
    config: str | Path | Config | None = None,
    settings: Sequence[str] = (),
    *,
    known: Map | str | Path | None = None,
    frozen: bool = False,
    hint: Sequence[float] | None = None,
    observers: Iterable[Observer] = (),
    progress: Progress | None = None,
) -> Map:
    """Map a log, or continue a map with it.

    Parameters
    ----------
    log : a file or folder; its format is detected from its content
    config : a preset's name, a file, or a config; by default the preset that fits the log
    settings : overrides of the config, each as "key=value"
    known : a map to continue, or its file; the start of the log is located in it
    frozen : localise in that map without changing it
    hint : (2,) or (3,) m, m, rad, approximate pose in the map at the start of the log
    observers : additional observers of the run
    progress : called with the position in the log and its length, in the source's own unit, and between
        the steps of refining the map; an exception ends the run

    Raises
    ------
    SourceError
        If the log cannot be read, contains no usable scan, lacks the odometry that the config requires, or
        is in `known` already.
    ConfigError
        If the config is invalid.

    Examples
    --------
    A simulated drive through a room:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import impslam
    >>> from impslam.simulation.robot import SimulatedRobot
    >>> from impslam.simulation.simulate import simulate
    >>> from impslam.simulation.world import load_world
    >>> from impslam.sources.recording import McapWriter
    >>> log = Path(tempfile.mkdtemp()) / "room.mcap"
    >>> with McapWriter(log) as writer:
    ...     for message in simulate(load_world("room"), SimulatedRobot(imu=None)):
    ...         writer.write(message)
    >>> known = impslam.run(log, "imp")
    >>> known.about["log"]
    'room.mcap'
    >>> sum(landmark.kind == "cylinder" for landmark in known.landmarks)
    2
    """
    begin = begin_with(known, frozen=frozen, hint=hint)
    chosen, source = open_log(log, config, settings)
    if begin is not None:
        chosen = for_continuing(chosen, settings)
    given = checked_observers(observers)
    return map_log(chosen, source, given, progress, begin, find_log_fault(chosen, source))


def map_log(
    config: Config,
    source: Source,
    observers: Iterable[Observer] = (),
    progress: Progress | None = None,
    begin: KnownMap | None = None,
    fault: LogFault = NO_FAULT,
) -> Map:
    """Map the log of a source; see `run`. `fault` is one of the whole log, which affects all poses."""
    if begin is not None:
        refuse_earlier(begin, source.path)
    current = Run(config, observers, begin, fault)
    report = progress or _ignore
    place: tuple[int, int | None] = 0, None
    current.estimator.check_with(lambda: report(*place))
    with source, current.salvaging(source):
        for batch in current.robot.streams.read(source):
            current.feed(batch)
            place = source.position, source.total  # known only while the source is open
            report(*place)
        current.flush()
    return current.finish(source)


def _ignore(*_: object) -> None:
    """Report no progress."""


class Run:
    """A run in progress: takes batches, returns the current map at any time.

    Logs, replays and live robots share this class and differ only in the source of the batches. It is not
    thread-safe. `begin` is a map to continue, `fault` one of the whole log, which affects all poses.
    """

    def __init__(
        self,
        config: Config,
        observers: Iterable[Observer] = (),
        begin: KnownMap | None = None,
        fault: LogFault = NO_FAULT,
    ) -> None:
        self.config, self._health = config, HealthMonitor(fault)
        self.robot = config.make_robot(for_estimator=True)
        self.tracker = config.make_tracker()
        self._watch = OdometryWatch(self.robot)
        self._observers = [self._health, self._watch, *observers]
        if begin is None:
            self.estimator, self._builder = config.make_estimator(), MapBuilder()
        else:
            known, frozen, hint = begin
            self.estimator = config.make_estimator(known, frozen=frozen, hint=hint)
            self._builder = MapBuilder(known, frozen=frozen)
        self._continuation = Continuation(begin)
        self._known_sweeps = len(self._builder)
        self._path: PathRows | None = None
        self._rng = np.random.default_rng(config.seed)
        self.clock, self.problems = Stopwatch(), Problems()
        self._threads = OneBlasThread()

    def feed(self, batch: Batch) -> None:
        """Process a batch, and pass the results to the observers."""
        for columns in batch.values():
            if columns.kind is TruePose:
                self._show_truth(columns.row(k) for k in range(len(columns)))
        with self.clock("sense"):
            sensed = self.robot.sense(batch)
        self._track(sensed)

    def flush(self) -> None:
        """Process the sweeps that still wait for odometry, with the motion received so far."""
        self._track(self.robot.flush())

    def play(self, messages: Iterable[Message]) -> Map:
        """Map a sequence of messages, one stream per type of message; return the map."""
        for batch in batches((type(message).__name__, message) for message in messages):
            self.feed(batch)
        self.flush()
        return self.map()

    def _track(self, sensed: Iterable[tuple[Motions, Sweeps]]) -> None:
        with self._threads:
            for motions, sweeps in sensed:
                tracks = self.tracker.follow(motions, sweeps, self.robot.systematic(sweeps))
                for tracked in self.clock.each("track", tracks):
                    for track in self._continuation.new_parts(tracked):
                        self._follow(track)
                        if track.keyframe is not None:
                            self._revise(self._observe(track.keyframe))

    def _follow(self, track: Track) -> None:
        if len(track.stamps):
            self._path = path = self._builder.follow(track)
            seal(track, path)
            for observer in self._observers:
                observer.follow(track, path)

    def _observe(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe with its scan and observations, or as it is if its scan is not trusted."""
        doubted = keyframe.reason == CHANGED and self.tracker.matches_scans
        if keyframe.reason == UNEXPLAINED or doubted:
            return keyframe
        with self.clock("extract"):
            sweeps, row = keyframe.sweeps, keyframe.row
            observations = self.robot.observe(sweeps, row, self._rng)
            return replace(keyframe, scan=sweeps.scan(row), observations=observations)

    def _revise(self, keyframe: Keyframe) -> None:
        with self.clock("estimate"):
            revision = self.estimator.add(keyframe)
            self.tracker.learn(self.estimator.systematic_errors)
        if revision.refused:
            self.problems.add("keyframe", revision.refused)
        self._path = path = self._builder.revise(keyframe, revision)
        seal(keyframe, revision, path)
        for observer in self._observers:
            observer.revise(keyframe, revision, path)

    def _show_truth(self, poses: Iterable[Any]) -> None:
        for pose in poses:
            for observer in self._observers:
                observer.truth(pose)

    @property
    def has_odometry(self) -> bool:
        """Whether any row of odometry was received."""
        return bool(self.robot.counts.get(self.robot.odometry.consumes.__name__))

    def dropped(self, *problems: Problems) -> dict[str, Dropped]:
        """Return the problems so far of all parts; `problems` are those of others, e.g. the source."""
        parts = (self.robot.problems, self.tracker.problems, self.problems, self._watch.problems)
        return dropped((*problems, *parts))

    @property
    def scans(self) -> int:
        """Number of sweeps used so far, without those of the map that is continued."""
        return len(self._builder) - self._known_sweeps

    def newest_health(self) -> tuple[int, str]:
        """Return the reason of the newest scan's health, as a code and in words."""
        return self._health.newest

    @property
    def odometry_notice(self) -> str:
        """One line on how much the scale of odometry differs from the config, or ""."""
        return self._watch.notice

    @property
    def odometry(self) -> Array:
        """`T_odom_base` (3,) at the newest sweep; see `T_map_odom`."""
        return self.tracker.odometry if self._path is None else self._path.odometry[-1].copy()

    @property
    def T_map_odom(self) -> Array:
        """(3,) m and rad: pose of the frame of dead reckoning in map, as of the newest sweep (REP 105).

        `compose(T_map_odom, odometry)` is the pose in map. When a loop closes, only `T_map_odom`
        jumps: a controller that must not jump works in odom, and transforms its goals to odom with the
        inverse. odom coincides with map at the start of the run. If the robot's own odometry starts
        elsewhere, use `compose(pose, inverse(own))` of the same stamp. Without odometry
        (`lidar_only`) dead reckoning stays at the start, so no pose is smooth.
        """
        path = self._path
        return np.zeros(3) if path is None else T_map_odom(path.poses[-1], path.odometry[-1])

    def keyframes(self) -> Keyframes:
        """Return the current keyframes, which is faster than `map`."""
        return self._builder.keyframes()

    def map(self) -> Map:
        """Return the current map; later data do not change it."""
        known = self._builder.map()
        # after an error, the estimator may have a keyframe that the map has not
        seen = self.estimator.observations()[: len(known.keyframes)]
        return completed(replace(known, observations=seen), self.estimator)

    def refined(self) -> Map:
        """Return the map with all keyframes refined jointly, which may take seconds."""
        with self.clock("refine"):
            revision = self.estimator.refine()
        if revision is not None and revision.refused:
            self.problems.add("refined map", revision.refused)
        known = self.map()
        return known if revision is None else blended(known.revised(revision))

    def draft(self, log: Path) -> Callable[[], tuple[Map, Outcome]]:
        """Return a function that computes the refined map as of now, and the facts of the run so far.

        This takes milliseconds. The returned function may take seconds, and may be called in another
        thread while the run continues. The run itself does not change.
        """
        estimate, outcome = self.estimator.draft(), self.outcome(log, "", 0)
        known = self._builder.map()
        seen = self.estimator.observations()
        logs = self._continuation.logs(outcome, self.scans)
        if len(seen) > len(known.keyframes):  # an error interrupted the newest revision
            partial = replace(self._matched(), about=about(outcome, logs))
            return lambda: (partial, outcome)
        known = replace(known, observations=seen)
        return functools.partial(_finished, known, estimate, outcome, logs)

    def _matched(self) -> Map:
        """Return the map without edges to a keyframe that the estimator has, but the map does not."""
        known = self.map()
        inside = np.maximum(known.edges.i, known.edges.j) < len(known.keyframes)
        return replace(known, edges=Edges._make(column[inside] for column in known.edges))

    def draft_landmarks(self) -> Callable[[], tuple[Landmark, ...]]:
        """Return a function that computes the landmarks as of now; another thread may call it."""
        return self.estimator.draft().landmarks

    def dead_reckoned(self) -> PathRows | None:
        """Return the newest pose composed with all later motion; None before the first sweep.

        This is the current pose while no scans arrive. The estimate does not change.
        """
        if not self.scans:
            return None
        ahead = self.robot.ahead()
        T, spread = compose_uncertain(
            *self.tracker.motion_since_keyframe, ahead.d_pose, ahead.covariance
        )
        odometry = compose(self.tracker.odometry, ahead.d_pose)
        return self._builder.locate(ahead.stamp, T, spread, odometry)

    def finish(self, source: Source) -> Map:
        """Finish the run of a log: pass map and outcome to the observers, and return the map.

        Raises
        ------
        SourceError
            If the log contains no usable scan, lacks the odometry that the config requires, or is in the
            continued map already.
        """
        self._refuse_empty(source)
        self.tracker.forget()
        with self.salvaging(source):
            known = self.refined()
        sessions = self.estimator.counts().get("sessions not found", 0)
        self._continuation.report(source.path, known, sessions, self.problems)
        return self._finish_observers(source, known)

    @contextmanager
    def salvaging(self, source: Source) -> Iterator[None]:
        """Pass the map so far to the observers if an error or a signal ends the block.

        The outcome is marked as partial. A file that cannot be written adds a note to the error.
        """
        try:
            yield
        except BaseException as error:
            if self.scans:
                try:
                    scans = self._continuation.repeated + self.scans
                    partial = f"{in_a_line(error)}; it holds the first {scans} scans of the log"
                    self._finish_observers(source, self._salvaged(), partial)
                except Exception as another:  # the first error is the one to report
                    error.add_note(in_a_line(another))
            raise

    def _salvaged(self) -> Map:
        """Return the refined map, or as much of it as possible if that fails or is interrupted."""
        with suppress(Exception, Interrupted):
            return self.refined()
        with suppress(Exception):
            return self._matched()
        return self._builder.map()

    def _finish_observers(self, source: Source, known: Map, partial: str = "") -> Map:
        outcome = self.outcome(
            source.path, fingerprint(source.path), len(known.landmarks), source.problems
        )
        outcome = replace(outcome, partial=partial)
        known = self.with_origin(known, outcome)
        self.finish_observers(known, outcome)
        return known

    def with_origin(self, known: Map, outcome: Outcome) -> Map:
        """Return the map of a run with its logs and the facts of the run."""
        return replace(known, about=about(outcome, self._continuation.logs(outcome, self.scans)))

    def finish_observers(self, known: Map, outcome: Outcome) -> None:
        """Pass the final map and the facts of the run to all observers; see `finish_all`."""
        finish_all(self._observers, known, outcome)

    def _refuse_empty(self, source: Source) -> None:
        if self.scans == 0 and self._continuation.refusal:
            raise SourceError(f"{source.path}: {self._continuation.refusal}")
        if self.scans == 0:
            raise SourceError(source.explain_emptiness())
        if not self.robot.has_seen:
            raise SourceError(
                f"{source.path}: none of the {self.scans} scans has a valid range; nothing can be mapped: "
                "check the lidar, or sensors.*.range_min, range_max and range_scale; `imp inspect` "
                "prints the limits"
            )
        if not self.has_odometry:
            wanted = self.robot.odometry.consumes.__name__
            why = source.most_frequent_problem(self.robot.streams.odometry.stream)
            hint = why or source.unknown_odometry() or "`imp inspect` lists its contents"
            raise SourceError(
                f"{source.path}: no {wanted} for odometry {self.config.odometry['kind']!r} in "
                f"it; {hint}; choose another with --set odometry.kind=..., or lidar_only to map without "
                "odometry"
            )

    def outcome(self, log: Path, sha256: str, landmarks: int, *problems: Problems) -> Outcome:
        """Return the facts of the run so far; `problems` are those of other parts, e.g. the source."""
        numbers = {"steps": self.scans, "landmarks": landmarks, **self.estimator.counts()}
        return Outcome(
            log=log,
            log_sha256=sha256,
            config=self.config.resolved(),
            counts={**self.robot.counts, **numbers},
            dropped=self.dropped(*problems),
            stages={name: np.array(times) for name, times in self.clock.stages.items()},
            log_seconds=self.robot.elapsed,
            wall_seconds=self.clock.elapsed,
            compile_seconds=self.clock.compiling,
            state_size=self.estimator.state_size,
            health=self._health.health._replace(silent=silent_time(self.robot.ahead())),
            lidar_alone=not self.robot.odometry.measures_motion,
        )


def _finished(
    known: Map, estimate: Draft, outcome: Outcome, logs: list[dict[str, Any]]
) -> tuple[Map, Outcome]:
    """Return the map with the refined poses and landmarks of an estimate, and the facts of the run."""
    begin = time.perf_counter()
    revision = estimate.refine()
    stages = {**outcome.stages, "refine": np.array([time.perf_counter() - begin])}
    unused = dict(outcome.dropped)
    if revision is not None:
        known = blended(known.revised(revision))
        if revision.refused:
            unused["refined map"] = Dropped(1, revision.refused)
    known = completed(known, estimate)
    counts = {**outcome.counts, "landmarks": len(known.landmarks)}
    outcome = replace(outcome, counts=counts, stages=stages, dropped=unused)
    return replace(known, about=about(outcome, logs)), outcome


class _Callable(ModuleType):
    """The type of this module, which makes it callable as `impslam.run(...)`."""

    def __call__(self, *args: Any, **more: Any) -> Map:
        return run(*args, **more)


sys.modules[__name__].__class__ = _Callable
