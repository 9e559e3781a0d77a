"""What `Robot.sense` does, one message at a time and in plain words: slow, short, without kernels.

Each message is a batch of its own for odometry, clocks and sensors, which have tests of their own; how
motions and sweeps meet is written out with `Increment`s, which compose to first order in their errors.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from impslam.columns import single_row
from impslam.geometry.se2 import compose, compose_jacobians, compose_uncertain, exp, inverse, log
from impslam.odometry.clocks import Clocks
from impslam.odometry.holding import MAX_ROWS
from impslam.odometry.stream import OdometryStream
from impslam.odometry.synchroniser import MAX_DELAY, MAX_WAIT, MIN_DURATION
from impslam.types import Increment


def at_rest(stamp):
    """Return the increment of a stationary robot."""
    return Increment(stamp, np.zeros(3), np.zeros((3, 3)))


def joined(first, second):
    """Return an increment followed by another, to first order in the errors."""
    d_pose, covariance = compose_uncertain(
        first.d_pose, first.covariance, second.d_pose, second.covariance
    )
    return Increment(second.stamp, d_pose, covariance, first.duration + second.duration)


def split(whole, fraction):
    """Split at a fraction in [0, 1] of the duration, at constant twist; `joined` rejoins the parts."""
    twist = log(whole.d_pose)
    cut = fraction * whole.duration
    head = exp(fraction * twist)
    tail = exp((1.0 - fraction) * twist)
    middle = whole.stamp - whole.duration + cut
    first, second = compose_jacobians(head, tail)
    # Split the covariance so that `joined` restores it: pull it back through the composition of
    # the two parts, in proportion to their durations.
    head_cov = np.linalg.solve(first, np.linalg.solve(first, fraction * whole.covariance).T)
    tail_cov = np.linalg.solve(
        second, np.linalg.solve(second, (1.0 - fraction) * whole.covariance).T
    )
    return (
        Increment(middle, head, head_cov, cut),
        Increment(whole.stamp, tail, tail_cov, whole.duration - cut),
    )


class Timeline:
    """The motion that no sweep has asked for yet."""

    def __init__(self):
        self.pending, self.newest, self.last = deque(), -np.inf, -np.inf
        self.latest = None

    def start(self, stamp):
        self.newest, self.last = max(self.newest, stamp), stamp

    def add(self, increment):
        duration = min(increment.duration, max(increment.stamp - self.newest, 0.0))
        self.start(increment.stamp)
        self.pending.append(replace(increment, stamp=self.newest, duration=duration))
        if increment.duration > 0.0:
            self.latest = increment

    def take(self, stamp, by_order=False):
        return consume(self.pending, stamp, by_order or stamp == self.last)

    def ahead(self, stamp):
        return consume(self.pending.copy(), stamp, stamp == self.last)

    def twist(self, begin, end):
        total = at_rest(begin)
        for increment in self.pending:
            if increment.stamp - increment.duration > end:
                break
            total = joined(total, increment)
        if total.duration > 0.0 and total.duration >= 0.5 * (end - begin):
            return log(total.d_pose) / total.duration
        last = self.latest
        return np.zeros(3) if last is None else log(last.d_pose) / last.duration


def consume(pending, stamp, together):
    total = at_rest(stamp)
    while pending:
        first = pending[0]
        begin = first.stamp - first.duration
        if not together and first.stamp > stamp:
            if begin < stamp:
                head, pending[0] = split(first, (stamp - begin) / first.duration)
                total = joined(total, head)
            break
        total = joined(total, pending.popleft())
    return replace(total, stamp=stamp)


@dataclass
class Row:
    """A sweep, and what it gets."""

    sensor: str
    columns: object
    begin: float
    end: float
    moment: float
    order: int
    by_order: bool
    due: float  # when it is in the queue
    queued: int = -1  # and at which row of the log
    motion: Increment | None = None
    twist: object = None
    T_middle_stamp: object = None
    stamp_covariance: object = None


class Reference:
    """An odometry on one stream and sensors on others."""

    def __init__(self, odometry, stream, sensors):
        self.stream, self.sensors, self.used = stream, sensors, []
        self.odometry, self.clocks, self.numbers = OdometryStream(odometry), Clocks(), {}
        self.timeline, self.waiting, self.held, self.newest = Timeline(), deque(), [], -np.inf
        self.arrived = -np.inf  # position in the log of the newest odometry

    def feed(self, stream, message, order):
        (row,) = single_row(stream, message, order).values()
        if stream == self.stream or stream in self.sensors:
            number = self.numbers.setdefault(stream, len(self.numbers))
            reference = self.numbers.get(self.stream, -1)
            placed, _ = self.clocks.place(np.array([number]), row.stamps, reference)
            (shift,), (time,), (by_order,) = placed.shifts, placed.times, placed.by_order
            self.newest = max(self.newest, time)
        if stream == self.stream:
            self.arrived = order
            motions, _, _ = self.odometry.motions(row, placed)
            increment = motions.row(0)
            if np.isnan(increment.d_pose).any():
                self.timeline.start(time)
            else:
                own = time if by_order else increment.stamp + shift
                self.timeline.add(replace(increment, stamp=own))
        if stream in self.sensors:
            name, sensor = self.sensors[stream]
            (begin,), (end,) = sensor.spans(row)
            begin, end = (time, time) if by_order else (begin + shift, end + shift)
            largest = max(other.latency for _, other in self.sensors.values())
            due = self.newest + (largest - sensor.latency)
            if by_order:  # all before it leave, too
                due = -np.inf
                for other in self.held:
                    other.due = -np.inf if other.sensor == name else other.due
            moment = begin if time - end > MAX_DELAY else time
            self.held.append(Row(name, row, begin, end, moment, order, by_order, due))
        self.queue(order, self.newest)
        self.release(order)

    def queue(self, order, now):
        held, self.held = self.held, []
        for row in held:
            is_due = row.due <= now or row.order + MAX_ROWS <= order
            row.queued = order
            (self.waiting if is_due else self.held).append(row)

    def release(self, seen):
        timeline = self.timeline
        while self.waiting:
            row = self.waiting[0]
            together = row.begin == row.end and row.moment == timeline.last
            known = timeline.newest >= max(row.end, row.moment)
            covered = timeline.newest >= row.end
            since = max(row.queued, self.arrived) if covered else row.queued
            late = seen - since >= MAX_WAIT
            if not (row.by_order or together or known or late):
                return
            self.waiting.popleft()
            if self.sensors[row.columns.stream][1].usable(row.columns).all():
                self.use(row)

    def use(self, row):
        timeline, middle = self.timeline, 0.5 * (row.begin + row.end)
        before = timeline.take(row.begin, row.by_order)
        row.twist = timeline.twist(row.begin, row.end)
        until = min(max(row.begin, row.moment), middle)
        before = joined(before, timeline.take(until))
        since = timeline.take(middle)
        row.motion = replace(joined(before, since), stamp=middle)
        missing = middle - until - since.duration
        if missing > MIN_DURATION and timeline.newest >= middle:  # an overlapping sweep has used it
            used = Increment(middle, exp(missing * row.twist), np.zeros((3, 3)), missing)
            since = joined(used, since)
        ahead = timeline.ahead(row.moment) if middle != row.moment else since
        row.T_middle_stamp = compose(inverse(since.d_pose), ahead.d_pose)
        row.stamp_covariance = (since.covariance + ahead.covariance) * (middle != row.moment)
        self.used.append(row)

    def flush(self):
        self.queue(0, np.inf)
        self.release(np.inf)
