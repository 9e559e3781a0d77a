"""Faults of sensors and logs, injected into the batches of a sound one: tests and benchmarks use them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from impslam.columns import Batch, Columns
from impslam.geometry.se2 import between, compose, exp, log
from impslam.types import LaserScan, OdometryPose, TruePose, WheelAngles

Change = Callable[[Columns], Columns]


def faulty(batches: Iterable[Batch], change: Change) -> Iterator[Batch]:
    """Yield batches with each of their columns changed; `change` sees those of a stream in order."""
    for batch in batches:
        yield {stream: change(columns) for stream, columns in batch.items()}


def with_values(columns: Columns, **values) -> Columns:
    return replace(columns, values={**columns.values, **values})


def with_layout(columns: Columns, **layout) -> Columns:
    return replace(columns, layout={**columns.layout, **layout})


def of(kind, change) -> Change:
    """Return a change of columns of one kind of message."""
    return lambda columns: change(columns) if issubclass(columns.kind, kind) else columns


def nothing() -> Change:
    return lambda columns: columns


# --------------------------------------------------------------------------- scans


def mirrored() -> Change:
    return of(LaserScan, lambda c: with_layout(c, angles=-c["angles"]))


def turned(angle: float) -> Change:
    return of(LaserScan, lambda c: with_layout(c, angles=c["angles"] + angle))


def wider_field(scale: float) -> Change:
    """Return a change of all angles between the beams, as of a wrong resolution in a log."""
    return of(LaserScan, lambda c: with_layout(c, angles=scale * c["angles"]))


def scaled_ranges(scale: float) -> Change:
    return of(LaserScan, lambda c: with_values(c, ranges=scale * c["ranges"]))


def longer_ranges(by: float) -> Change:
    """Return a change of all ranges but those of beams that return nothing."""

    def change(c: Columns) -> Columns:
        ranges = c["ranges"]
        return with_values(c, ranges=np.where(ranges > 0.0, np.maximum(ranges + by, 0.0), ranges))

    return of(LaserScan, change)


def millimetres(limit: float) -> Change:
    """Give ranges in mm, with a limit in the messages."""
    return of(
        LaserScan,
        lambda c: with_layout(with_values(c, ranges=1000.0 * c["ranges"]), range_max=limit),
    )


def no_return(value: float) -> Change:
    """Give a value to a tenth of the beams, and to those that have none."""

    def change(c: Columns) -> Columns:
        ranges, drawn = c["ranges"].copy(), np.random.default_rng(0).random(c["ranges"].shape)
        with np.errstate(invalid="ignore"):
            ranges[(drawn < 0.1) | ~np.isfinite(ranges)] = value
        return with_values(c, ranges=ranges)

    return of(LaserScan, change)


def noisy_no_return(limit: float, sigma: float, clamped: bool = False) -> Change:
    """Give range_max = limit to beams that see nothing within it, with noise as of some simulators."""
    rng = np.random.default_rng(0)

    def change(c: Columns) -> Columns:
        ranges = c["ranges"].copy()
        far = ~((ranges > 0.0) & (ranges < limit))
        noisy = limit + sigma * rng.standard_normal(ranges.shape)
        ranges[far] = (np.minimum(noisy, limit) if clamped else noisy)[far]
        return with_layout(with_values(c, ranges=ranges), range_max=limit)

    return of(LaserScan, change)


def body(width: float) -> Change:
    """Put a part of the robot in view, width rad of the middle half of the beams."""

    def change(c: Columns) -> Columns:
        angles, ranges = c["angles"], c["ranges"].copy()
        first = len(angles) // 4
        hidden = np.abs(angles - angles[first]) <= width
        hidden[:first] = False
        noise = np.random.default_rng(0).normal(0.0, 0.005, (len(c), int(hidden.sum())))
        ranges[:, hidden] = 0.35 + noise
        return with_values(c, ranges=ranges)

    return of(LaserScan, change)


def late(seconds: float) -> Change:
    return of(LaserScan, lambda c: with_values(c, stamp=c["stamp"] + seconds))


def delayed(scans: int) -> Change:
    """Show the ranges of so many scans earlier; the first scans repeat the first one."""
    waiting: list[np.ndarray] = []

    def change(c: Columns) -> Columns:
        ranges = c["ranges"]
        if not waiting:
            waiting.append(np.repeat(ranges[:1], scans, axis=0))
        ranges = np.concatenate([waiting.pop(), ranges])
        waiting.append(ranges[len(c) :])
        return with_values(c, ranges=ranges[: len(c)])

    return of(LaserScan, change)


def jitter(seconds: float) -> Change:
    """Stamp scans at random, by a standard deviation of so many s, early or late, twice that at most."""
    rng = np.random.default_rng(0)

    def change(c: Columns) -> Columns:
        by = np.clip(rng.normal(0.0, seconds, len(c)), -2.0 * seconds, 2.0 * seconds)
        return with_values(c, stamp=c["stamp"] + by)

    return of(LaserScan, change)


def busy(begin: float, max_wait: float = 0.4, late: float = 0.05, max_late: float = 0.8) -> Change:
    """Stamp rows several at once from `begin` s on, and some rows up to 0.8 s later still.

    The computer stamps waiting rows at random intervals of up to `max_wait` s; in a share `late` of these
    turns, the stamps are late by up to `max_late` s more.
    """
    rng = np.random.default_rng(0)
    turns = begin + np.cumsum(rng.uniform(0.0, max_wait, 2000))
    extra = np.where(rng.uniform(size=2000) < late, rng.uniform(0.0, max_late, 2000), 0.0)

    def change(c: Columns) -> Columns:
        if c.kind is TruePose:
            return c
        turn = np.searchsorted(turns, c.stamps)
        since = 1e-3 * (c.stamps - turns[turn])  # keeps the order within a turn
        return with_values(c, stamp=turns[turn] + extra[turn] + since)

    return change


def sweep_of(seconds: float) -> Change:
    def change(c: Columns) -> Columns:
        return with_layout(c, time_offsets=np.linspace(0.0, seconds, len(c["angles"])))

    return of(LaserScan, change)


def reversed_sweep() -> Change:
    """Reverse the beams, but not their times, as a driver does for a lidar that spins clockwise."""

    def change(c: Columns) -> Columns:
        backward = {n: c[n][..., ::-1] for n in ("ranges", "intensities") if c[n] is not None}
        return with_layout(with_values(c, **backward), angles=c["angles"][::-1])

    return of(LaserScan, change)


# --------------------------------------------------------------------------- wheels


def swapped(scale: float = 1.0) -> Change:
    return of(
        WheelAngles, lambda c: with_values(c, left=scale * c["right"], right=scale * c["left"])
    )


def reversed_wheels(*sides: str) -> Change:
    return of(WheelAngles, lambda c: with_values(c, **{side: -c[side] for side in sides}))


def wrapping(at: float) -> Change:
    return of(
        WheelAngles,
        lambda c: with_values(c, left=np.mod(c["left"], at), right=np.mod(c["right"], at)),
    )


def restarted(after: float) -> Change:
    """Begin the counters of the wheels anew, as when their computer restarts `after` s from the start."""
    offsets: dict[str, float] = {}

    def change(c: Columns) -> Columns:
        offsets.setdefault("stamp", c["stamp"][0] + after)
        late = c["stamp"] >= offsets["stamp"]
        values = {}
        for side in ("left", "right"):
            if late.any():
                offsets.setdefault(side, c[side][late][0])
            values[side] = c[side] - np.where(late, offsets.get(side, 0.0), 0.0)
        return with_values(c, **values)

    return of(WheelAngles, change)


# --------------------------------------------------------------------------- odometry


def standing() -> Change:
    def still(c: Columns) -> Columns:
        first = {name: c[name] for name in c.values if name != "stamp"}
        return with_values(c, **{name: 0.0 * column for name, column in first.items()})

    return of((WheelAngles, OdometryPose), still)


def stopping(begin: float, seconds: float) -> Change:
    """Hold the readings of odometry for some time; then it goes on from there."""
    held: dict[str, np.ndarray] = {}

    def change(c: Columns) -> Columns:
        if not held:
            held["stamp"] = c["stamp"][0] + begin
        still = (c["stamp"] >= held["stamp"]) & (c["stamp"] < held["stamp"] + seconds)
        values = {}
        for name in set(c.values) - {"stamp"}:
            before = c[name][~still & (c["stamp"] < held["stamp"])]
            if len(before):
                held[name] = before[-1]
            values[name] = c[name].copy()
            values[name][still] = held[name]
        return with_values(c, **values)

    return of((WheelAngles, OdometryPose), change)


def blocked(width: float) -> Change:
    """Cover the lidar over a width in rad, on the right of its middle."""

    def change(c: Columns) -> Columns:
        middle, ranges = c["angles"].mean(), c["ranges"].copy()
        ranges[:, (c["angles"] < middle) & (c["angles"] > middle - width)] = 0.0
        return with_values(c, ranges=ranges)

    return of(LaserScan, change)


def parked() -> Change:
    """Let the robot stand: every scan shows what the first one does, with noise of 1 cm."""
    rng, still, first = np.random.default_rng(0), standing(), dict[str, np.ndarray]()

    def change(c: Columns) -> Columns:
        seen = first.setdefault(c.stream, c["ranges"][0])
        return with_values(c, ranges=seen + 0.01 * rng.standard_normal(c["ranges"].shape))

    scans = of(LaserScan, change)
    return lambda columns: still(scans(columns))


def scaled_odometry(way: float, turn: float) -> Change:
    """Scale ways and turns of the poses of odometry."""
    return _of_motions(lambda twists: twists * [way, way, turn])


def rounded(metres: float, radians: float) -> Change:
    """Round the poses of odometry."""

    def change(c: Columns) -> Columns:
        steps = np.array([metres, metres, radians])
        return with_values(c, pose=np.round(c["pose"] / steps) * steps)

    return of(OdometryPose, change)


def unsigned() -> Change:
    """Let odometry log ways backward as forward."""
    return _of_motions(lambda twists: np.abs(twists) * [1.0, 0.0, 0.0] + twists * [0.0, 0.0, 1.0])


def _of_motions(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the twists (m, 3) between poses of odometry."""
    last: list[np.ndarray] = []  # the newest pose as it was, and as it is now

    def changed(c: Columns) -> Columns:
        poses = c["pose"].copy()
        before, now = last or (poses[0], poses[0].copy())
        steps = exp(change(log(between(np.vstack((before, poses[:-1])), poses))))
        for k, step in enumerate(steps):
            now = compose(now, step)
            poses[k] = now
        last[:] = c["pose"][-1], now
        return with_values(c, pose=poses)

    return of(OdometryPose, changed)


def there_and_back(batches: Iterable[Batch]) -> list[Batch]:
    """Return a drive, and after it the same backward in time: the robot drives back, astern."""
    there = list(batches)
    ends = [float(c.stamps.max()) for batch in there for c in batch.values()]
    orders = [int(c.order.max()) for batch in there for c in batch.values()]
    turn, last = 2.0 * max(ends) + 0.1, 2 * max(orders) + 1

    def back(c: Columns) -> Columns:
        c = c.take(slice(None, None, -1))
        offset = float(c["time_offsets"].max(initial=0.0)) if c.kind is LaserScan else 0.0
        c = replace(c, order=last - c.order)
        return with_values(c, stamp=turn - c["stamp"] - offset)

    return there + [{name: back(c) for name, c in batch.items()} for batch in reversed(there)]
