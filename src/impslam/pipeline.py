"""From a source to observers: synchronisation, bookkeeping, timing. The mathematics is in `slam`."""

from __future__ import annotations

import hashlib
import math
import time
from array import array
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from impslam.columns import messages
from impslam.config import Config, Keyframes
from impslam.errors import MessageError, NumericalError, SourceError
from impslam.geometry.se2 import compose, inverse
from impslam.observers.base import Dropped, Observer, Outcome
from impslam.odometry.clocks import Clocks
from impslam.odometry.timeline import Timeline
from impslam.sensors.base import Reading, Sensor
from impslam.sources.base import Problems, Source
from impslam.types import Increment, Message, StepResult, TruePose

MAX_WAIT = 25
"""Messages a scan waits for odometry to reach its end; then it is used with what is known."""


class Stopwatch:
    """Seconds per stage, one entry a scan."""

    def __init__(self) -> None:
        self.stages: dict[str, array[float]] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a block."""
        begin = time.perf_counter()
        yield
        self.stages.setdefault(stage, array("d")).append(time.perf_counter() - begin)


class Gate:
    """Tells keyframes from the scans between them."""

    def __init__(self, keyframes: Keyframes) -> None:
        self._limits = keyframes
        self._way, self._turn, self._since = np.inf, np.inf, np.inf

    def passes(self, increment: Increment) -> bool:
        """Tell whether the scan after this motion is a keyframe."""
        d, limits = increment.d_pose, self._limits
        self._way += math.hypot(d[0], d[1])
        self._turn += abs(float(d[2]))
        self._since += increment.duration
        if (
            self._way < limits.distance
            and self._turn < limits.angle
            and self._since < limits.seconds
        ):
            return False
        self._way = self._turn = self._since = 0.0
        return True


class Pipeline:
    """Feeds a robot's messages to the estimator in the order in which they happened."""

    def __init__(self, config: Config) -> None:
        self.robot, self.slam = config.make_robot(), config.make_slam()
        self._matcher = config.make_matcher()
        self._timeline = Timeline()
        self._waiting: deque[tuple[Message, Sensor, float, tuple[float, float], int]] = deque()
        self._rng = np.random.default_rng(config.seed)
        self._clock = Stopwatch()
        self._gate = Gate(config.keyframes)
        self._newest: StepResult | None = None  # the timeline's motion begins where it ends
        self._seen = 0
        self.counts: dict[str, int] = {}
        self.problems = Problems()
        self.clocks, self._shift = Clocks(self.problems), 0.0  # s, of odometry

    def feed(self, message: Message) -> Iterator[StepResult]:
        """Take in one message; yield a result for each scan that it completes."""
        self._seen += 1
        name = type(message).__name__
        self.counts[name] = self.counts.get(name, 0) + 1
        if self.robot.feels(message):
            self._feel(message)
        sensor = self.robot.sensor_for(message)
        if sensor is not None:
            shift = self.clocks.shift(name, message.stamp)
            begin, end = sensor.span(message)
            span = begin + shift, end + shift
            self._waiting.append((message, sensor, message.stamp + shift, span, self._seen))
        yield from self._ready(flush=False)

    def play(self, messages: Iterable[Message]) -> Iterator[StepResult]:
        """Take in a whole log; yield a result for each scan."""
        for message in messages:
            yield from self.feed(message)
        yield from self.flush()

    def flush(self) -> Iterator[StepResult]:
        """Use the scans that still wait for odometry; the log is over."""
        yield from self._ready(flush=True)

    def _feel(self, message: Message) -> None:
        shift = self._shift = self.clocks.shift(type(message).__name__, message.stamp)
        try:
            increment = self.robot.odometry.update(message)
        except MessageError as error:
            self.problems.add("odometry", str(error))
            increment = None
        if increment is None:
            self._timeline.start(message.stamp + shift)
        else:
            self._timeline.add(replace(increment, stamp=increment.stamp + shift))

    def _ready(self, flush: bool) -> Iterator[StepResult]:
        while self._waiting:
            message, sensor, moment, (begin, end), since = self._waiting[0]
            together = begin == end and self._timeline.ends_at(moment)
            known = self._timeline.covers(max(end, moment))
            patient = self._seen - since < MAX_WAIT
            if not (flush or together or known or not patient):
                return
            self._waiting.popleft()
            result = self._use(message, sensor, moment, begin, end)
            if result is not None:
                yield replace(result, stamp=message.stamp)

    def _use(
        self, message: Message, sensor: Sensor, moment: float, begin: float, end: float
    ) -> StepResult | None:
        with self._clock("odometry"):
            before = self._timeline.take(begin)
            twist = self._timeline.twist(begin, end - begin)
            middle = 0.5 * (begin + end)
            before = before.then(self._timeline.take(min(max(begin, moment), middle)))
            since = self._timeline.take(middle)
            motion = before.then(since)
            increment = replace(motion, stamp=moment)
        try:
            with self._clock("sensor"):
                look = self._gate.passes(increment)
                reading = sensor.observe(message, twist, self._rng, look)
            result = self._estimate(increment, reading)
        except MessageError as error:
            self.problems.add("scan", str(error))
            self._timeline.put_back(motion)
            return None
        if reading.scan is not None and not reading.scan.valid.any():
            self.problems.add(
                "scan without valid beams",
                f"the scan at {message.stamp:.3f} s has no valid range; the pose is dead-reckoned "
                "there: check the lidar, or sensors.*.range_min and range_max",
            )
        if middle == moment:
            return result
        return _at_stamp(result, since, self._timeline.ahead(moment))

    def _estimate(self, increment: Increment, reading: Reading) -> StepResult:
        """Take a reading into matcher and filter: into both, or with `NumericalError` into neither."""
        refined, matcher = increment, self._matcher
        try:
            if matcher is not None and reading.scan is not None:
                matcher = matcher.model_copy()
                with self._clock("matching"):
                    refined = matcher.refine(increment, reading.scan)
            with self._clock("slam"):
                result = self.slam.step(refined, reading, increment)
        except NumericalError as error:
            raise NumericalError(
                f"the scan at {increment.stamp:.3f} s is dropped: {error}"
            ) from error
        self._matcher, self._newest = matcher, result
        return result

    def dead_reckoned(self) -> StepResult | None:
        """Return the newest result, carried on by all motion since; None before the first one.

        That is where a robot is whose scans do not come. The filter is left as it is.
        """
        if self._newest is None:
            return None
        ahead = self._timeline.all_ahead()
        carried = _at_stamp(self._newest, Increment.none(ahead.stamp), ahead)
        return replace(carried, stamp=ahead.stamp - self._shift)

    @property
    def waiting(self) -> int:
        """How many scans wait for odometry."""
        return len(self._waiting)

    @property
    def stages(self) -> dict[str, array[float]]:
        """Seconds per stage."""
        return self._clock.stages


def _at_stamp(result: StepResult, since: Increment, ahead: Increment) -> StepResult:
    """Carry the pose from the middle of a sweep to its stamp, by dead reckoning.

    `since` is the motion from an earlier stamp to the middle, `ahead` that on to a later one.
    """
    motion = replace(
        ahead,
        d_pose=compose(inverse(since.d_pose), ahead.d_pose),
        covariance=since.covariance + ahead.covariance,
    )
    pose, covariance = motion.advance(result.pose, result.covariance)
    odometry = compose(result.odometry, motion.d_pose)
    return replace(result, pose=pose, covariance=covariance, odometry=odometry)


class Run:
    """A run in progress: messages in, results to the observers, and its books.

    Logs, replays and live robots differ in where messages come from and when; this is the rest.
    One thread at a time may use it.

    Attributes
    ----------
    pipeline : what estimates
    steps : scans used by now
    """

    def __init__(self, config: Config, observers: Iterable[Observer] = ()) -> None:
        self._config, self._observers, self.pipeline = config, list(observers), Pipeline(config)
        self.steps = 0
        self._begin = time.perf_counter()

    def feed(self, message: Message) -> None:
        """Take in one message; the observers see each scan that it completes."""
        if isinstance(message, TruePose):
            for observer in self._observers:
                observer.truth(message)
        self._show(self.pipeline.feed(message))

    def flush(self) -> None:
        """Use the scans that still wait for odometry, which will not come."""
        self._show(self.pipeline.flush())

    def _show(self, results: Iterable[StepResult]) -> None:
        for result in results:
            self.steps += 1
            for observer in self._observers:
                observer.step(result)

    def finish(self, source: Source) -> Outcome:
        """Tell the observers what the run of this log was, and return it.

        Raises
        ------
        SourceError
            If the log holds no scan that could be used, or no odometry.
        """
        _refuse_empty(self._config, source, self.pipeline, self.steps)
        outcome = self.outcome(source.path, fingerprint(source.path), source.problems)
        for observer in self._observers:
            observer.finish(outcome)
        return outcome

    def outcome(self, log: Path, sha256: str, *problems: Problems) -> Outcome:
        """Return what the run is by now; `problems` are those outside of the pipeline."""
        pipeline = self.pipeline
        landmarks = pipeline.slam.landmarks()
        return Outcome(
            log=log,
            log_sha256=sha256,
            config=self._config.resolved(),
            counts={**pipeline.counts, "steps": self.steps, "landmarks": len(landmarks)},
            dropped=_join(*problems, pipeline.problems),
            stages={name: np.array(times) for name, times in pipeline.stages.items()},
            log_seconds=pipeline.clocks.elapsed,
            wall_seconds=time.perf_counter() - self._begin,
            landmarks=landmarks,
            state_size=pipeline.slam.filter.state_size,
        )


def run(config: Config, source: Source, observers: Iterable[Observer] = ()) -> Outcome:
    """Run a log through the estimator and show every result to the observers.

    Raises
    ------
    SourceError
        If the log holds no scan that could be used, or no odometry.
    """
    course = Run(config, observers)
    with source:
        for message in messages(source.batches()):
            course.feed(message)
        course.flush()
    return course.finish(source)


def _refuse_empty(config: Config, source: Source, pipeline: Pipeline, steps: int) -> None:
    felt = pipeline.robot.odometry.consumes.__name__
    if steps == 0:
        raise SourceError(f"{source.path}: no usable scan in it; `imp inspect` tells what it holds")
    if not pipeline.counts.get(felt):
        raise SourceError(
            f"{source.path}: no {felt} for odometry {config.odometry['kind']!r} in it; "
            "`imp inspect` tells what it holds, -c or --set odometry.kind=... chooses another"
        )


def _join(*many: Problems) -> dict[str, Dropped]:
    return {
        kind: Dropped(count, problems.examples[kind])
        for problems in many
        for kind, count in problems.counts.items()
    }


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder's files in order of their names."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
