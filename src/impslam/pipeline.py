"""From a source to observers: synchronisation, bookkeeping, timing. The mathematics is in `slam`."""

from __future__ import annotations

import hashlib
import math
import time
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from impslam.columns import Motions, Sweeps, batch, batches, messages
from impslam.config import Config, Keyframes
from impslam.errors import MessageError, NumericalError, SourceError
from impslam.geometry.se2 import compose, compose_uncertain
from impslam.matching.check import Checked, OdometryCheck
from impslam.observers.base import Dropped, Observer, Outcome
from impslam.sensors.base import Reading
from impslam.sources.base import Problems, Source
from impslam.trust import Trust
from impslam.types import Array, Increment, Message, StepResult, TruePose

_CONTRADICTED = (
    "the scan at {:.3f} s shows another motion than odometry; the pose follows the scans: check encoders "
    "and wheels, or the parameters of odometry"
)


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
        self._check, self._matcher = OdometryCheck(), config.make_matcher()
        self._rng = np.random.default_rng(config.seed)
        self._clock = Stopwatch()
        self._gate = Gate(config.keyframes)
        self._newest: StepResult | None = None  # the robot's motion ahead begins where it ends
        self._owed: Increment | None = None  # of scans that were dropped
        self._seen = 0

    @property
    def counts(self) -> dict[str, int]:
        """Messages by type."""
        return self.robot.counts

    @property
    def problems(self) -> Problems:
        """What was dropped, and why."""
        return self.robot.problems

    def feed(self, message: Message) -> Iterator[StepResult]:
        """Take in one message; yield a result for each scan that it completes."""
        self._seen += 1
        yield from self._used(self.robot.sense(batch(type(message).__name__, message, self._seen)))

    def play(self, log: Iterable[Message]) -> Iterator[StepResult]:
        """Take in a whole log; yield a result for each scan."""
        for part in batches((type(message).__name__, message) for message in log):
            yield from self._used(self.robot.sense(part))
        yield from self.flush()

    def flush(self) -> Iterator[StepResult]:
        """Use the scans that still wait for odometry; the log is over."""
        yield from self._used(self.robot.flush())

    def _used(self, sensed: Iterable[tuple[Motions, Sweeps]]) -> Iterator[StepResult]:
        for motions, sweeps in sensed:
            for k in range(len(sweeps)):
                with self._clock("odometry"):
                    motion = self._motion(motions, sweeps, k)
                try:
                    result = self._use(motion, sweeps, k)
                except MessageError as error:
                    self.problems.add("scan", str(error))
                    self._owed = motion
                    continue
                yield result

    def _motion(self, motions: Motions, sweeps: Sweeps, k: int) -> Increment:
        motion, owed = motions.row(k), self._owed
        self._owed = None
        motion = motion if owed is None else owed.then(motion)
        return replace(motion, stamp=float(sweeps.columns.stamps[k]))

    def _use(self, motion: Increment, sweeps: Sweeps, k: int) -> StepResult:
        with self._clock("sensor"):
            look = self._gate.passes(motion)
            seen = self.robot.look(sweeps, k, self._rng) if look else ()
        result = self._estimate(motion, Reading(sweeps.scan(k), seen, look))
        return _at_stamp(result, sweeps.T_middle_stamp[k], sweeps.stamp_covariance[k])

    def _estimate(self, increment: Increment, reading: Reading) -> StepResult:
        """Take a reading into check, matcher and filter: into all, or with `NumericalError` into none."""
        check, matcher, motion = self._check.copy(), self._matcher, Checked(increment, False)
        try:
            if reading.scan is not None:
                with self._clock("matching"):
                    motion = check.check(increment, reading.scan)
                    if matcher is not None:
                        matcher = matcher.model_copy()
                        refined = matcher.refine(motion.increment, reading.scan)
                        motion = motion._replace(increment=refined)
            with self._clock("slam"):
                result = self.slam.step(motion.increment, reading, increment)
        except NumericalError as error:
            raise NumericalError(
                f"the scan at {increment.stamp:.3f} s is dropped: {error}"
            ) from error
        if motion.contradicted:
            self.problems.add("odometry against scans", _CONTRADICTED.format(increment.stamp))
        result = replace(result, contradicted=motion.contradicted)
        self._check, self._matcher, self._newest = check, matcher, result
        return result

    def dead_reckoned(self) -> StepResult | None:
        """Return the newest result, carried on by all motion since; None before the first one.

        That is where a robot is whose scans do not come. The filter is left as it is.
        """
        if self._newest is None:
            return None
        ahead = self.robot.ahead()
        ahead = ahead if self._owed is None else self._owed.then(ahead)
        carried = _at_stamp(self._newest, ahead.d_pose, ahead.covariance)
        return replace(carried, stamp=ahead.stamp)

    @property
    def waiting(self) -> int:
        """How many scans wait for odometry."""
        return self.robot.waiting

    @property
    def stages(self) -> dict[str, array[float]]:
        """Seconds per stage."""
        return self._clock.stages


def _at_stamp(result: StepResult, T_middle_stamp: Array, covariance: Array) -> StepResult:
    """Carry the pose from the middle of a sweep to its stamp, by dead reckoning."""
    pose, spread = compose_uncertain(result.pose, result.covariance, T_middle_stamp, covariance)
    odometry = compose(result.odometry, T_middle_stamp)
    return replace(result, pose=pose, covariance=spread, odometry=odometry)


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
        self.steps, self._trust = 0, Trust()
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
            self._trust.step(result)
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
            log_seconds=pipeline.robot.elapsed,
            wall_seconds=time.perf_counter() - self._begin,
            landmarks=landmarks,
            state_size=pipeline.slam.filter.state_size,
            health=self._trust.health,
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
