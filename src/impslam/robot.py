"""The robot's sensors: one odometry and any number of exteroceptive sensors (thesis 5.1, Fig. 22).

Exteroceptive sensors own the extractors that find landmarks in their data. Sensors and extractors are
added by tables in the config, without code.

The robot turns batches of a log into sweeps with the motion since the previous sweep. The size of the
batches does not change the result: see `impslam.odometry.synchroniser`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from impslam.columns import Batch, Columns, Motions, Sweeps
from impslam.noise import SystematicErrors
from impslam.odometry.base import Odometry, diagonal
from impslam.odometry.clocks import BY_ORDER, PlacedRows
from impslam.odometry.gyro import GyroFusion
from impslam.odometry.holding import Holding
from impslam.odometry.pending import PendingQueue, PendingRows
from impslam.odometry.stream import OdometryStream, unknown_motions
from impslam.odometry.stream_clocks import StreamClocks
from impslam.odometry.synchroniser import (
    END,
    MAX_DELAY,
    PendingSweeps,
    Synchronised,
    Synchroniser,
)
from impslam.odometry.turn_errors import TurnErrors
from impslam.sensors.base import Sensor
from impslam.sources.base import Problems
from impslam.streams import Reader, Streams
from impslam.types import Array, Imu, Increment, Ints, Observation

TWIST_SIGMA = np.array([0.5, 0.5, 1.0])
"""m/s, m/s, rad/s, sigma of the motion within a sweep without odometry: half a walking pace."""


class Robot:
    """One odometry and any number of named exteroceptive sensors.

    Attributes
    ----------
    streams : which stream of the log each part reads
    counts : number of rows by type of message
    problems : count and first example of each kind of problem
    has_seen : whether any sweep so far was not a scan without a valid beam
    """

    def __init__(
        self,
        name: str,
        odometry: Odometry,
        sensors: Mapping[str, Sensor],
        *,
        without_systematic: bool = False,
    ) -> None:
        """`without_systematic` leaves these errors out of the covariances of motions; see `systematic`."""
        self.name, self.odometry, self.sensors = name, odometry, sensors
        rest, wheels = odometry.split() if without_systematic else (odometry, None)
        self.counts: dict[str, int] = {}
        self.problems = Problems()
        self.has_seen = False
        fuses = odometry.gyro.use and odometry.measures_motion
        self.streams = Streams(
            Reader("odometry", odometry.consumes, odometry.stream),
            {n: Reader(f"sensors.{n}", s.consumes, s.stream) for n, s in sensors.items()},
            Reader("odometry.gyro", Imu, odometry.gyro.stream) if fuses else None,
        )
        considered = (wheels or SystematicErrors(0.0, 0.0)) if without_systematic else None
        self._gyro = GyroFusion(
            odometry.gyro, odometry.lever, odometry.standstill_band.angle, considered
        )
        self._turn_errors = TurnErrors(wheels, odometry.gyro.scale) if without_systematic else None
        self._odometry_stream, self._synchroniser = OdometryStream(rest), Synchroniser()
        self._queue, self._clocks = PendingQueue(), StreamClocks()
        self._holding = Holding({n: getattr(s, "latency", 0.0) for n, s in sensors.items()})
        self._shift = 0.0  # s, from the newest odometry stamp to its time
        self._has_begun = False  # without odometry: whether a sweep was used
        # Position in the log, kind, example, count.
        self._faults: list[tuple[int, str, str, int]] = []

    # ------------------------------------------------------------------ sensing

    def sense(self, batch: Batch) -> Iterator[tuple[Motions, Sweeps]]:
        """Process a batch; return the sweeps that it completes, in the order of the log.

        Each item holds consecutive sweeps of one sensor. Motion k is that of base_link from the
        middle of the previous sweep (of any sensor) to the middle of sweep k. Sweeps that odometry
        does not cover yet are returned with a later batch.
        """
        last = max((int(columns.order[-1]) for columns in batch.values()), default=0)
        for columns in batch.values():
            name = columns.kind.__name__
            self.counts[name] = self.counts.get(name, 0) + len(columns)
        used = self.streams.used(batch)
        each, reports = self._clocks.place(used, self.streams.odometry.stream)
        self._faults += reports
        placed = dict(zip((c.stream for c in used), each, strict=True))
        odometry = [c for c in used if c.stream == self.streams.odometry.stream]
        gyro = self.streams.gyro
        turns = next((c for c in used if gyro and c.stream == gyro.stream), None)
        rows = [
            self._pending_rows(name, columns, placed[columns.stream])
            for name, reader in self.streams.sensors.items()
            for columns in used
            if columns.stream == reader.stream
        ]
        if self._holding.is_needed:
            rows = self._holding.release(rows, *_in_order(used, placed))
        order, motions = self._motions(odometry, placed)
        if gyro and gyro.stream:
            motions = self._corrected(order, motions, turns, placed)
        found = self._synchronise(order, motions, rows, last)
        self._record_faults()
        return iter(found)

    def flush(self) -> Iterator[tuple[Motions, Sweeps]]:
        """Return the sweeps that still wait for odometry, with the motion received so far."""
        refused = self._gyro.rejection()
        if refused:
            self._faults.append((END, "gyro", refused, 1))
        found = self._synchronise(*self._motions([], {}), self._holding.flush(), END)
        self._record_faults()
        return iter(found)

    def wait_for_rows_only(self) -> None:
        """Do not wait `MAX_LATE` s for late odometry: the map of a live robot must not lag behind it."""
        self._synchroniser.max_late = 0.0

    def ahead(self) -> Increment:
        """Return the motion from the middle of the newest sweep to the newest odometry.

        It extrapolates the pose while no sweeps arrive. The state does not change.
        """
        ahead = self._synchroniser.ahead()
        if not self.odometry.measures_motion:
            ahead = replace(ahead, covariance=np.diag((TWIST_SIGMA * ahead.duration) ** 2))
        return replace(ahead, stamp=ahead.stamp - self._shift)

    def observe(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Extract the landmarks in row k of the sweeps, in base_link at the middle of the sweep."""
        return self.sensors[sweeps.sensor].observe(sweeps, k, rng)

    @property
    def pending(self) -> int:
        """Number of sweeps that wait for odometry, or for those of a later sensor."""
        return len(self._queue) + len(self._holding)

    @property
    def gyro_turns(self) -> bool:
        """Whether turns are measured by a gyro instead of the wheels."""
        return self.streams.gyro is not None and self._gyro.trusted

    def systematic(self, sweeps: Sweeps) -> Sequence[SystematicErrors | None]:
        """Return, for each sweep, the errors of odometry that the covariances do not contain."""
        if self._turn_errors is None:
            return [None] * len(sweeps)
        return self._turn_errors.at(sweeps.columns.order)

    @property
    def elapsed(self) -> float:
        """Duration of the log so far in s, corrected for clocks that were set; NaN if unknown."""
        return self._clocks.elapsed

    # ------------------------------------------------------------------ steps

    def _motions(
        self, odometry: list[Columns], placed: Mapping[str, PlacedRows]
    ) -> tuple[Ints, Motions]:
        """Return (m,) positions of the odometry rows in the log, and their motions."""
        if not odometry:
            return np.empty(0, np.int64), unknown_motions(np.empty(0))
        (rows,) = odometry
        times = placed[rows.stream]
        self._shift = float(times.times[-1] - rows.stamps[-1])
        motions, faults, example = self._odometry_stream.motions(rows, times)
        if example:
            first = int(rows.order[np.argmax(faults)])
            self._faults.append((first, "odometry", example, int(faults.sum())))
        stamps = np.where(times.how == BY_ORDER, times.times, motions.stamps + times.shifts)
        return rows.order, motions._replace(stamps=stamps)

    def _corrected(
        self, order: Ints, motions: Motions, turns: Columns | None, placed: Mapping[str, PlacedRows]
    ) -> Motions:
        """Return the motions with turns corrected by the gyro; record wheel slip."""
        stamps = np.empty(0) if turns is None else placed[turns.stream].times
        motions, apart, shares = self._gyro.correct(order, motions, turns, stamps)
        if self._turn_errors is not None:
            self._turn_errors.add(order, shares)
        for found in apart:
            text = (
                f"within 1 s before {found.stamp - self._shift:.3f} s the wheels turn by "
                f"{math.degrees(found.wheels):.1f} deg and the gyro by {math.degrees(found.gyro):.1f} deg: "
                "the wheels slip or the robot is pushed; the heading follows the gyro"
            )
            self._faults.append((found.order, "wheel slip", text, 1))
        return motions

    def _pending_rows(self, name: str, columns: Columns, placed: PlacedRows) -> PendingRows:
        """Return the rows of a sensor for the queue; record the unusable ones as faults."""
        sensor, shift = self.sensors[name], placed.shifts
        spans, by_order = sensor.spans(columns), placed.by_order
        begins, ends = (np.where(by_order, placed.times, at + shift) for at in spans)
        usable = sensor.usable(columns)
        if not usable.all():
            first = int(np.argmin(usable))
            example, count = sensor.fault(columns.row(first)), int(np.sum(~usable))
            self._faults.append((int(columns.order[first]), sensor.row_name, example, count))
        # The pose at a stamp of another clock is that at the beginning of the sweep.
        stamps = np.where(placed.times - ends > MAX_DELAY, begins, placed.times)
        times = PendingSweeps(columns.order, begins, ends, stamps, usable, by_order)
        return PendingRows(name, sensor, columns, times)

    def _synchronise(
        self, order: Ints, motions: Motions, rows: list[PendingRows], last: int
    ) -> list[tuple[Motions, Sweeps]]:
        """Return the sweeps that odometry covers, with their motions."""
        pending = self._queue.push(rows)
        got = self._synchroniser.feed(order, motions, pending, last)
        if not self.odometry.measures_motion:
            got = self._without_odometry(pending, got)
        found = self._queue.pop(got)
        for _, sweeps in found:
            self._count_blind(sweeps)
        return found

    def _without_odometry(self, pending: PendingSweeps, got: Synchronised) -> Synchronised:
        """Return motions of a robot whose odometry measures none.

        Within the first sweep there is none, because the pose there is the origin.
        """
        ahead = np.abs(pending.stamps[: len(got.twists)] - got.motions.stamps)
        covariance = got.motions.covariance.copy()
        usable = np.flatnonzero(pending.usable[: len(got.twists)])
        if len(usable) and not self._has_begun:
            first, self._has_begun = usable[0], True
            covariance[first] = ahead[first] = 0.0
        return got._replace(
            motions=got.motions._replace(covariance=covariance),
            stamp_covariance=diagonal(np.outer(ahead**2, TWIST_SIGMA**2)),
        )

    def _count_blind(self, sweeps: Sweeps) -> None:
        """Record scans without a valid beam; their motion is still used."""
        if sweeps.scans is None:
            self.has_seen = True
            return
        blind = ~sweeps.scans.valid.any(axis=1)
        self.has_seen |= not blind.all()
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

    def _record_faults(self) -> None:
        for _, kind, example, count in sorted(self._faults, key=itemgetter(0)):
            self.problems.add(kind, example, count)
        self._faults.clear()


def _in_order(used: list[Columns], placed: Mapping[str, PlacedRows]) -> tuple[Ints, Array]:
    """Return the positions in the log (r,) of all rows, in order, and their times (r,) s."""
    order = np.concatenate([np.empty(0, np.int64), *(columns.order for columns in used)])
    times = np.concatenate([np.empty(0), *(placed[columns.stream].times for columns in used)])
    rows = np.argsort(order)
    return order[rows], times[rows]
