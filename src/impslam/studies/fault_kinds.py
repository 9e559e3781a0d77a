"""The faults of `imp reproduce faults`: functions from a drive to its faulty recording.

Faults that occur during a drive begin between a third and a half of it. Faults of odometry act on the
distances of the two wheels; for a log of odometry poses, these are those of a robot with a track of
`TRACK`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from impslam.columns import Columns
from impslam.geometry.se2 import between, compose, exp, inverse, log
from impslam.studies.drives import RecordedDrive, metres_per_reading, with_values
from impslam.types import Array, OdometryPose

Rng: TypeAlias = np.random.Generator
Fault: TypeAlias = Callable[[RecordedDrive, Rng], RecordedDrive]

TRACK = 0.4
"""m between wheels that are not in the log."""
FROZEN, GAP, SLIP, HOUR = 10.0, 30.0, 0.5, 3600.0
"""s that a device is frozen, s without data, m of sudden slip, and s by which a clock jumps."""
COVER_RANGE, BODY_RADIUS, PEOPLE = 0.3, 0.2, 6
"""m to an object that covers beams, m of a person's radius, and the number of people."""
ORDER_SCALE = 1 << 20
"""Factor on the orders of rows, to leave room for inserted rows."""
RANGE_NOISE = 0.01
"""m, noise of simulated ranges."""


def draw_begin(drive: RecordedDrive, rng: Rng) -> int:
    """Draw the row of scans at which a fault begins."""
    n = len(drive.scans)
    return int(rng.integers(n // 3, n // 2))


def none(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Change nothing."""
    del rng
    return drive


# ------------------------------------------------------------------ rows of scans


def dropped(share: float) -> Fault:
    """Lose a share of the scans."""

    def fault(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
        kept = rng.random(len(drive.scans)) >= share
        kept[0] = True
        return drive.keep(kept, slice(None))

    return fault


def doubled(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Record every scan twice."""
    del rng
    return drive.keep(np.repeat(np.arange(len(drive.scans)), 2), slice(None))


def shuffled(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Shuffle the scans, with their stamps, within each half second."""
    n, block = len(drive.scans), drive.rows(0.5)
    rows = np.lexsort((rng.random(n), np.arange(n) // block))
    moved = drive.keep(rows, slice(None))
    return moved._replace(scans=replace(moved.scans, order=drive.scans.order))


def gap(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Record no data for a while."""
    i = draw_begin(drive, rng)
    j = i + drive.rows(GAP)
    rows = np.arange(len(drive.scans))
    return drive.keep((rows < i) | (rows >= j), ~drive.after(i) | drive.after(j))


def late(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Delay the ranges of the scans by 0.3 s."""
    del rng
    rows = np.maximum(np.arange(len(drive.scans)) - drive.rows(0.3), 0)
    return drive.with_scans(ranges=drive.scans["ranges"][rows])


def repeated(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Repeat one scan for a while."""
    i = draw_begin(drive, rng)
    ranges = drive.scans["ranges"].copy()
    ranges[i : i + drive.rows(FROZEN)] = ranges[i]
    return drive.with_scans(ranges=ranges)


# ------------------------------------------------------------------ ranges


def turned(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Turn the lidar on its mount by 5 degrees during the drive."""
    i, angles = draw_begin(drive, rng), drive.scans["angles"]
    step = float(np.median(np.diff(angles)))
    beams = round(math.radians(5.0) / step)
    ranges = drive.scans["ranges"].copy()
    ranges[i:] = np.roll(ranges[i:], -beams, axis=1)
    if abs(len(angles) * step) < 2.0 * math.pi - 2.0 * abs(step):  # beams outside the field of view
        ranges[i:, slice(-beams, None) if beams > 0 else slice(None, -beams)] = math.nan
    return drive.with_scans(ranges=ranges)


def mirrored(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Mount the lidar upside down, without a change of the config."""
    del rng
    return drive.with_scans(ranges=drive.scans["ranges"][:, ::-1].copy())


def covered(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Cover half of the beams with an object on the robot, from some time on."""
    i, n = draw_begin(drive, rng), drive.scans["ranges"].shape[1]
    ranges, first = drive.scans["ranges"].copy(), int(rng.integers(0, n // 2))
    hidden = ranges[i:, first : first + n // 2]
    hidden[:] = COVER_RANGE + RANGE_NOISE * rng.standard_normal(hidden.shape)
    return drive.with_scans(ranges=ranges)


def filled(value: float) -> Fault:
    """Set 30 % of the beams to an invalid range."""

    def fault(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
        ranges = drive.scans["ranges"]
        bad = rng.random(ranges.shape) < 0.3
        return drive.with_scans(ranges=np.where(bad, value, ranges))

    return fault


def scaled(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Measure all ranges 3 % too long."""
    del rng
    return drive.with_scans(ranges=1.03 * drive.scans["ranges"])


def people(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Add people who walk along with the robot, 0.7 to 3 m away."""
    scans, n = drive.scans, len(drive.scans)
    seconds = drive.period * np.arange(n)[:, None]
    phase, rate, swing = rng.uniform(-1.0, 1.0, (3, PEOPLE))
    bearing = math.pi * phase + 0.5 * rate * seconds
    distance = 1.85 + 1.15 * np.sin(0.5 * swing * seconds + 10.0 * phase)
    ranges = np.array(scans["ranges"], np.float64)
    for k in range(PEOPLE):
        angles = scans["angles"] - (bearing[:, k : k + 1] - drive.truth[:, 2:])
        along, across = (distance[:, k : k + 1] * f(angles) for f in (np.cos, np.sin))
        hit = (along > 0.0) & (np.abs(across) < BODY_RADIUS)
        front = along - np.sqrt(np.maximum(BODY_RADIUS**2 - across**2, 0.0))
        front += RANGE_NOISE * rng.standard_normal(front.shape)
        ranges = np.where(hit & ((ranges <= COVER_RANGE / 2.0) | ~(ranges < front)), front, ranges)
    return drive.with_scans(ranges=ranges)


# ------------------------------------------------------------------ odometry


def absent(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Record no odometry."""
    del rng
    return drive.keep(slice(None), slice(0, 0))


def reset(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Reset odometry to 0 during the drive."""
    odometry, on = drive.odometry, drive.after(draw_begin(drive, rng))
    first = int(np.argmax(on))
    values = {}
    if odometry.kind is OdometryPose:
        pose = odometry["pose"]
        moved = compose(inverse(pose[first]), pose)
        values["pose"] = np.where(on[:, None], moved, pose)
    else:
        for name in ("left", "right"):
            values[name] = odometry[name] - np.where(on, odometry[name][first], 0.0)
    return drive._replace(odometry=with_values(odometry, **values))


def with_wheels(drive: RecordedDrive, change: Callable[[Array], Array]) -> RecordedDrive:
    """Return the drive with changed distances (m, 2) in m of the left and the right wheel, by row."""
    odometry = drive.odometry
    if odometry.kind is OdometryPose:
        return drive._replace(odometry=with_values(odometry, pose=_integrate(odometry, change)))
    unit = metres_per_reading(drive.config.odometry)
    readings = np.column_stack((odometry["left"], odometry["right"])).astype(np.float64)
    distances = unit * np.diff(readings, axis=0, prepend=readings[:1])
    left, right = (readings[0] + np.cumsum(change(distances), axis=0) / unit).T
    return drive._replace(odometry=with_values(odometry, left=left, right=right))


def _integrate(odometry: Columns, change: Callable[[Array], Array]) -> Array:
    """Return the poses of odometry with changed distances of the wheels and unchanged sideways motion."""
    pose: Array = odometry["pose"]
    twists = log(between(pose[np.maximum(np.arange(len(pose)) - 1, 0)], pose))
    half = 0.5 * TRACK * twists[:, 2]
    left, right = change(np.column_stack((twists[:, 0] - half, twists[:, 0] + half))).T
    steps = exp(np.column_stack((0.5 * (left + right), twists[:, 1], (right - left) / TRACK)))
    out = np.empty_like(pose)
    out[0] = pose[0]
    for k in range(1, len(pose)):
        out[k] = compose(out[k - 1], steps[k])
    return out


def wheels(factors: tuple[float, float], seconds: float = FROZEN) -> Fault:
    """Scale the distances of the left and the right wheel for a while."""

    def fault(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
        i = draw_begin(drive, rng)
        during = drive.after(i) & ~drive.after(i + drive.rows(seconds))
        return with_wheels(drive, lambda d: np.where(during[:, None], d * np.array(factors), d))

    return fault


def slipped(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Add half a metre of slip to both wheels within half a second."""
    i = draw_begin(drive, rng)
    during = drive.after(i) & ~drive.after(i + drive.rows(0.5))
    return with_wheels(drive, lambda d: d + (during / max(during.sum(), 1) * SLIP)[:, None])


def swapped(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Exchange the wheels."""
    del rng
    return with_wheels(drive, lambda distances: distances[:, ::-1])


# ------------------------------------------------------------------ time and position


def stuck(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Drive against a wall: the robot is stationary for a while, and its wheels turn at 0.3 m/s."""
    i, more_scans = draw_begin(drive, rng), drive.rows(FROZEN)
    n, m, j = len(drive.scans), len(drive.odometry), int(np.sum(~drive.after(i)))
    more, seconds = round(more_scans * m / n), more_scans * drive.period
    order = int(drive.scans.order[i]) - 1
    stay = drive.keep(
        np.insert(np.arange(n), i, [i] * more_scans), np.insert(np.arange(m), j, [j] * more)
    )
    scans = _spread_inserted(stay.scans, slice(i, i + more_scans), order, seconds)
    odometry = _spread_inserted(stay.odometry, slice(j, j + more), order, seconds)
    ranges = scans["ranges"].astype(np.float64)
    ranges[i : i + more_scans] += RANGE_NOISE * rng.standard_normal((more_scans, ranges.shape[1]))
    spin = np.zeros((m + more, 1))
    spin[j : j + more] = 0.3 * seconds / more
    still = stay._replace(scans=with_values(scans, ranges=ranges), odometry=odometry)
    return with_wheels(still, lambda distances: distances + spin)


def _spread_inserted(columns: Columns, rows: slice, order: int, seconds: float) -> Columns:
    """Spread inserted rows over a time in s after an order of the log; delay the following rows."""
    share = np.clip((np.arange(len(columns)) - rows.start) / (rows.stop - rows.start), 0.0, 1.0)
    orders = columns.order * ORDER_SCALE
    orders[rows] = order * ORDER_SCALE + (share[rows] * (ORDER_SCALE - 1)).astype(np.int64)
    moved = with_values(columns, stamp=columns.stamps + seconds * share)
    return replace(moved, order=orders)


def kidnapped(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
    """Carry the robot along a part of its path, at least 2 m, without motion of odometry."""
    i, n = draw_begin(drive, rng), len(drive.scans)
    far = np.hypot(*(drive.truth[:, :2] - drive.truth[i, :2]).T) > 2.0
    far[: i + 1], far[n - n // 5 :] = False, False
    if not far.any():
        return drive
    j = int(rng.choice(np.flatnonzero(far)))
    rows, until = np.arange(n), drive.after(j)
    carried = drive.after(i) & ~until
    moved = with_wheels(drive, lambda distances: np.where(carried[:, None], 0.0, distances))
    seconds = drive.scans.stamps[j] - drive.scans.stamps[i] - drive.period
    scans = with_values(moved.scans, stamp=moved.scans.stamps - np.where(rows >= j, seconds, 0.0))
    odometry = with_values(
        moved.odometry, stamp=moved.odometry.stamps - np.where(until, seconds, 0.0)
    )
    moved = moved._replace(scans=scans, odometry=odometry)
    return moved.keep((rows <= i) | (rows > j), ~carried)


def stamped(change: Callable[[Array, float], Array]) -> Fault:
    """Change all stamps from some time on."""

    def fault(drive: RecordedDrive, rng: Rng) -> RecordedDrive:
        i = draw_begin(drive, rng)
        first = float(drive.scans.stamps[i])

        def stamps(columns: Columns) -> Columns:
            on = columns.order >= drive.scans.order[i]
            return with_values(
                columns, stamp=np.where(on, change(columns.stamps, first), columns.stamps)
            )

        return drive._replace(odometry=stamps(drive.odometry), scans=stamps(drive.scans))

    return fault


FAULTS: dict[str, Fault] = {
    "none": none,
    "scans dropped, 1 %": dropped(0.01),
    "scans dropped, 5 %": dropped(0.05),
    "scans dropped, 20 %": dropped(0.2),
    "scans dropped, 50 %": dropped(0.5),
    "scans doubled": doubled,
    "scans shuffled": shuffled,
    "no data for 30 s": gap,
    "scans 0.3 s late": late,
    "one scan repeated for 10 s": repeated,
    "lidar turned by 5° on the way": turned,
    "lidar mirrored": mirrored,
    "half of the beams covered": covered,
    "30 % of the beams NaN": filled(math.nan),
    "30 % of the beams infinite": filled(math.inf),
    "30 % of the beams negative": filled(-1.0),
    "ranges 3 % too long": scaled,
    "people around": people,
    "odometry absent": absent,
    "odometry frozen for 10 s": wheels((0.0, 0.0)),
    "one wheel frozen for 10 s": wheels((0.0, 1.0)),
    "odometry reset to 0": reset,
    "slip of 20 % for 30 s": wheels((1.2, 1.2), 30.0),
    "slip of 0.5 m": slipped,
    "wheels swapped": swapped,
    "against a wall for 10 s": stuck,
    "kidnapped": kidnapped,
    "stamps jump an hour": stamped(lambda stamps, first: stamps + HOUR),
    "stamps run backward": stamped(lambda stamps, first: 2.0 * first - stamps),
}
