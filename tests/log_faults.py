"""Faults of sensors and logs, injected into the batches of a sound one: tests and benchmarks use them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from impslam.columns import Batch, Columns
from impslam.types import LaserScan, OdometryPose, WheelAngles

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


# --------------------------------------------------------------------------- scans


def mirrored() -> Change:
    return of(LaserScan, lambda c: with_layout(c, angles=-c["angles"]))


def turned(angle: float) -> Change:
    return of(LaserScan, lambda c: with_layout(c, angles=c["angles"] + angle))


def scaled_ranges(scale: float, offset: float = 0.0) -> Change:
    return of(LaserScan, lambda c: with_values(c, ranges=scale * c["ranges"] + offset))


def late(seconds: float) -> Change:
    return of(LaserScan, lambda c: with_values(c, stamp=c["stamp"] + seconds))


# --------------------------------------------------------------------------- wheels


def exchanged() -> Change:
    return of(WheelAngles, lambda c: with_values(c, left=c["right"], right=c["left"]))


def reversed_wheels(*sides: str) -> Change:
    return of(WheelAngles, lambda c: with_values(c, **{side: -c[side] for side in sides}))


# --------------------------------------------------------------------------- odometry


def standing() -> Change:
    def still(c: Columns) -> Columns:
        first = {name: c[name] for name in c.values if name != "stamp"}
        return with_values(c, **{name: 0.0 * column for name, column in first.items()})

    return of((WheelAngles, OdometryPose), still)
