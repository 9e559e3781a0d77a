"""The robot: what it feels of its own motion, and what it sees (thesis 5.1, Fig. 22).

Proprioceptive sensing is one odometry; exteroceptive sensors carry the extractors that look for
landmarks in their data. A sensor or an extractor is added by a table in the config, not by code.

Batches of a log go in; sweeps come out, each with the motion since the one before. How a log is cut
into batches changes nothing: see `impslam.odometry.synchroniser`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from impslam.columns import Batch, Columns, Motions, Sweeps
from impslam.odometry.base import Odometry
from impslam.odometry.clocks import Clocks
from impslam.odometry.following import Follower, nothing_told
from impslam.odometry.synchroniser import END, Synchroniser
from impslam.sensors.base import Sensor
from impslam.sources.base import Problems
from impslam.streams import Reader, Streams
from impslam.types import Array, Increment, Ints, Message, Observation
from impslam.waiting import Queue, Rows


class Robot:
    """One odometry and any number of exteroceptive sensors by name.

    Attributes
    ----------
    counts : rows by the type of message
    problems : what was dropped, and why
    """

    def __init__(self, name: str, odometry: Odometry, sensors: Mapping[str, Sensor]) -> None:
        self.name, self.odometry, self.sensors = name, odometry, sensors
        self.counts: dict[str, int] = {}
        self.problems = Problems()
        self._streams = Streams(
            Reader("odometry", odometry.consumes, odometry.stream),
            {n: Reader(f"sensors.{n}", s.consumes, s.stream) for n, s in sensors.items()},
        )
        self._follower, self._synchroniser, self._queue = (
            Follower(odometry),
            Synchroniser(),
            Queue(),
        )
        self._clocks = Clocks()
        self._numbers: dict[str, int] = {}  # of streams, for the clocks
        self._shift = 0.0  # s, of odometry
        self._faults: list[tuple[int, str, str, int]] = []  # place in the log, kind, example, count

    # ------------------------------------------------------------------ streams

    @property
    def wanted(self) -> tuple[str, ...]:
        """The names of the streams that the config asks for."""
        return self._streams.wanted

    def choose(self, defaults: Mapping[type[Message], str]) -> None:
        """Say which stream of a kind to use where the config names none; else it is the first."""
        self._streams.choose(defaults)

    def check(self, streams: Iterable[str]) -> None:
        """Raise `ConfigError` if the config names a stream that is not among these."""
        self._streams.check(streams)

    def check_reads(self, kind: type[Message], stream: str) -> None:
        """Raise `ConfigError` unless rows of a kind and stream are of use."""
        self._streams.check_reads(kind, stream)

    # ------------------------------------------------------------------ sensing

    def sense(self, batch: Batch) -> Iterator[tuple[Motions, Sweeps]]:
        """Take in a piece of the log; yield the sweeps that it completes, in the order of the log.

        They come in runs of one sensor. Motion k of a run is that of base_link up to the middle of
        sweep k, from the middle of the sweep before, whichever sensor's that was. A sweep that is not
        complete comes with a later batch.
        """
        last = max((int(columns.order[-1]) for columns in batch.values()), default=0)
        for columns in batch.values():
            name = columns.kind.__name__
            self.counts[name] = self.counts.get(name, 0) + len(columns)
        used = self._streams.used(batch)
        shifts = dict(zip((c.stream for c in used), self._shifts(used), strict=True))
        felt = [c for c in used if c.stream == self._streams.odometry.stream]
        rows = [
            self._waiting(name, columns, shifts[columns.stream])
            for name, reader in self._streams.sensors.items()
            for columns in used
            if columns.stream == reader.stream
        ]
        found = self._pass_on(*self._follow(felt, shifts), rows, last)
        self._enter_faults()
        return iter(found)

    def flush(self) -> Iterator[tuple[Motions, Sweeps]]:
        """Use the sweeps that still wait for odometry, which will not come; yield them."""
        found = self._pass_on(*self._follow([], {}), [], END)
        self._enter_faults()
        return iter(found)

    def ahead(self) -> Increment:
        """Return all motion since the middle of the newest sweep, at the newest odometry's stamp.

        That is where a robot is whose sweeps do not come. Nothing is used up.
        """
        ahead = self._synchroniser.ahead()
        return replace(ahead, stamp=ahead.stamp - self._shift)

    def look(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the landmarks that row k of the sweeps shows, in base_link in its middle."""
        return self.sensors[sweeps.sensor].look(sweeps, k, rng)

    @property
    def waiting(self) -> int:
        """How many sweeps wait for odometry."""
        return len(self._queue)

    @property
    def elapsed(self) -> float:
        """How long the log is by now, s, whatever was done to its clocks."""
        return self._clocks.elapsed

    # ------------------------------------------------------------------ steps

    def _shifts(self, used: list[Columns]) -> list[Array]:
        """Return for each stream what brings its stamps onto the one time line, s."""
        if not used:
            return []
        order = np.concatenate([columns.order for columns in used])
        place = np.argsort(order)
        number = [self._numbers.setdefault(c.stream, len(self._numbers)) for c in used]
        streams = np.repeat(np.array(number), [len(columns) for columns in used])
        stamps = np.concatenate([columns.stamps for columns in used])
        shifts = np.empty(len(order))
        shifts[place], steps = self._clocks.shifts(streams[place], stamps[place])
        names = list(self._numbers)
        for step in steps:
            said = f"the clock {step} ({names[step.stream]}); motion is kept in file order"
            self._faults.append((int(order[place[step.row]]), "clock step", said, 1))
        return np.split(shifts, np.cumsum([len(columns) for columns in used])[:-1])

    def _follow(self, felt: list[Columns], shifts: Mapping[str, Array]) -> tuple[Ints, Motions]:
        """Return the places in the log of the rows of odometry, and their motions on the one time line."""
        if not felt:
            return np.empty(0, np.int64), nothing_told(np.empty(0))
        (rows,) = felt
        shift = shifts[rows.stream]
        self._shift = float(shift[-1])
        motions, faults, example = self._follower.follow(rows)
        if example:
            first = int(rows.order[np.argmax(faults)])
            self._faults.append((first, "odometry", example, int(faults.sum())))
        return rows.order, motions._replace(stamps=motions.stamps + shift)

    def _waiting(self, name: str, columns: Columns, shift: Array) -> Rows:
        """Return a sensor's rows as they wait, and enter those that cannot be used."""
        sensor = self.sensors[name]
        begins, ends = sensor.spans(columns)
        usable = sensor.usable(columns)
        if not usable.all():
            first = int(np.argmin(usable))
            example, count = sensor.fault(columns.row(first)), int(np.sum(~usable))
            self._faults.append((int(columns.order[first]), "scan", example, count))
        return Rows(
            name, sensor, columns, begins + shift, ends + shift, columns.stamps + shift, usable
        )

    def _pass_on(
        self, order: Ints, motions: Motions, rows: list[Rows], last: int
    ) -> list[tuple[Motions, Sweeps]]:
        """Return the sweeps that need not wait, with their motions."""
        waiting = self._queue.join(rows)
        found = self._queue.leave(self._synchroniser.feed(order, motions, waiting, last))
        for _, sweeps in found:
            self._count_blind(sweeps)
        return found

    def _count_blind(self, sweeps: Sweeps) -> None:
        """Enter scans of which no beam is valid; they are used, for their motion."""
        if sweeps.scans is None:
            return
        blind = ~sweeps.scans.valid.any(axis=1)
        if not blind.any():
            return
        first = int(np.argmax(blind))
        self._faults.append((
            int(sweeps.columns.order[first]),
            "scan without valid beams",
            f"the scan at {sweeps.columns.stamps[first]:.3f} s has no valid range; the pose is "
            "dead-reckoned there: check the lidar, or sensors.*.range_min and range_max",
            int(blind.sum()),
        ))  # fmt: skip

    def _enter_faults(self) -> None:
        for _, kind, example, count in sorted(self._faults):
            self.problems.add(kind, example, count)
        self._faults.clear()

    # ------------------------------------------------------------------ kinds of messages

    def feels(self, kind: type[Message]) -> bool:
        """Tell whether the odometry understands messages of a kind."""
        return issubclass(kind, self.odometry.consumes)

    def sensor_for(self, kind: type[Message]) -> Sensor | None:
        """Return the first sensor that understands messages of a kind, if any."""
        return next((s for s in self.sensors.values() if issubclass(kind, s.consumes)), None)
