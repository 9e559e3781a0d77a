"""Trajectories against the truth: alignment, absolute and relative errors.

A trajectory has rows (n, 4) of stamp, x, y, theta; theta is NaN if only the position is known, and errors
that need it are then NaN. Errors are computed in the truth's frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impslam.errors import ImpError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose, inverse, transform
from impslam.types import Array

START_DURATION = 1.0
"""s after the first pose within which a first known heading counts as the heading at the start."""
POSE_TOLERANCE = (0.05, math.radians(3.0))
"""m and rad: two poses closer than this are assumed to be in the same frame."""

BETTER_FIT = 3.0
"""Ratio of two RMS errors from which the truth and the path clearly differ in unit or handedness."""
MAX_SCALE = 1.05
"""Ratio of lengths that errors of a lidar or of a survey explain."""
MAX_TURN = math.radians(20.0)
"""Heading error that only wrong headings of the truth explain, if the positions fit."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of absolute errors, in the unit of the errors; NaN if there are none."""

    count: int
    rmse: float
    mean: float
    median: float
    max: float


@dataclass(frozen=True, slots=True, eq=False)
class PosePairs:
    """Estimated and true poses (n, 3) at the same stamps (n,)."""

    stamps: Array
    estimate: Array
    truth: Array

    def moved(self, T_truth_estimate: Array) -> PosePairs:
        """Return the pairs with the estimate moved to the frame of the truth, by the transform (3,)."""
        return PosePairs(self.stamps, compose(T_truth_estimate, self.estimate), self.truth)

    def aligned(self) -> PosePairs:
        """Return the pairs with the estimate fitted to the truth."""
        return self.moved(align(self.estimate[:, :2], self.truth[:, :2]))


def statistics(errors: Array) -> Statistics:
    """Return the statistics of absolute errors (n,); NaN (unknown) values are left out."""
    e = np.abs(errors[~np.isnan(errors)])
    if len(e) == 0:
        return Statistics(0, math.nan, math.nan, math.nan, math.nan)
    rmse = math.sqrt(float(np.mean(e * e)))
    return Statistics(len(e), rmse, float(e.mean()), float(np.median(e)), float(e.max()))


def interpolate(trajectory: Array, stamps: Array) -> Array:
    """Return poses (k, 3) at the stamps, linearly interpolated and constant beyond the ends.

    A heading is unknown if one of its two neighbours is unknown.
    """
    rows = trajectory[np.argsort(trajectory[:, 0], kind="stable")]
    t, x, y, heading = rows.T.copy()
    known = np.isfinite(heading)
    heading[known] = np.unwrap(heading[known])
    poses = np.column_stack([np.interp(stamps, t, column) for column in (x, y, heading)])
    poses[:, 2] = wrap(poses[:, 2])
    return poses


def interpolation_error(trajectory: Array, stamps: Array) -> float:
    """Return the RMS error in m of positions interpolated linearly at the stamps (k,).

    Across h s between two poses, an acceleration a causes an error of a t (h - t) / 2 after t s. It is
    computed from the differences of the speeds before and after each pose.
    """
    t, first = np.unique(trajectory[:, 0], return_index=True)
    if len(t) < 3:
        return 0.0
    speeds = np.diff(trajectory[first, 1:3], axis=0) / np.diff(t)[:, None]
    at_poses = np.hypot(*np.diff(speeds, axis=0).T) / (0.5 * (t[2:] - t[:-2]))
    i = np.clip(np.searchsorted(t, stamps, side="right") - 1, 0, len(t) - 2)
    after = np.clip(stamps - t[i], 0.0, t[i + 1] - t[i])
    errors = np.interp(stamps, t[1:-1], at_poses) * after * (t[i + 1] - t[i] - after) / 2.0
    return math.sqrt(float(np.mean(errors**2)))


def associate(estimate: Array, truth: Array, slack: float = 0.1, gap: float = 1.0) -> PosePairs:
    """Pair an estimate with the truth interpolated to its stamps.

    Parameters
    ----------
    estimate, truth : (n, 4) and (m, 4) stamp, x, y, heading: s, m, m, rad
    slack : s, maximum time of a stamp before the first or after the last true pose
    gap : s, maximum time between true poses for an interpolation

    Raises
    ------
    ImpError
        If no stamp of the estimate is within the truth, or all are in longer gaps.
    """
    known = np.sort(truth[:, 0])
    stamps = estimate[:, 0]
    after = np.clip(np.searchsorted(known, stamps), 1, max(len(known) - 1, 1))
    hole = np.diff(known, append=known[-1])[after - 1] > gap
    exact = np.isin(stamps, known)
    within = (stamps >= known[0] - slack) & (stamps <= known[-1] + slack)
    inside = within & (exact | ~hole)
    if within.any() and not inside.any():
        raise ImpError(
            f"all true poses around those of the estimate are more than {gap:g} s apart, too far to "
            "interpolate; give a truth with more poses"
        )
    if not inside.any():
        raise ImpError(
            f"the estimate (from {stamps.min():.3f} to {stamps.max():.3f} s) and the truth (from "
            f"{known[0]:.3f} to {known[-1]:.3f} s) do not overlap in time; check that both use one clock"
        )
    chosen = estimate[inside]
    return PosePairs(chosen[:, 0], chosen[:, 1:], interpolate(truth, chosen[:, 0]))


def align(points: Array, target: Array) -> Array:
    """Return the rigid motion (3,) that moves points (n, 2) closest to target (n, 2).

    Umeyama 1991 without scale. In the plane the rotation has a closed form, so the result is never a
    reflection; if all points coincide, the rotation is zero.
    """
    centre, wanted = points.mean(axis=0), target.mean(axis=0)
    p, q = points - centre, target - wanted
    dot = float(np.sum(p * q))
    cross = float(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    theta = math.atan2(cross, dot)
    shift = wanted - transform(np.array([0.0, 0.0, theta]), centre[None])[0]
    return np.array([shift[0], shift[1], theta])


def misfit(pairs: PosePairs) -> str:
    """Say what is wrong with a truth that fits the path in another unit, mirrored or turned; else "".

    With positions p of the path and q of the truth as complex numbers, centred, the similarity q = a p
    leaves sum |q|^2 - |sum p* q|^2 / sum |p|^2. If the truth is mirrored, p takes the place of p*.
    """
    p, q = _centred(pairs.estimate), _centred(pairs.truth)
    size, true_size = float(np.sum(np.abs(p) ** 2)), float(np.sum(np.abs(q) ** 2))
    if not min(size, true_size) > 0.0:
        return ""
    direct, mirrored = float(abs(np.vdot(p, q))), float(abs(p @ q))
    rigid, best = size + true_size - 2.0 * direct, max(direct, mirrored)
    scale = best / size
    if (true_size - best * scale) * BETTER_FIT**2 < rigid * scale**2:
        if mirrored > direct:
            return (
                "fits the path if it is mirrored; its y axis must point to the left of its x axis"
            )
        if abs(math.log(scale)) > math.log(MAX_SCALE):
            return f"is {scale:.4g} times as large as the path, but fits otherwise; it must be in m"
    turn = statistics(heading_errors(pairs.aligned())).median
    if turn > MAX_TURN and rigid * BETTER_FIT**2 < true_size:
        return (
            f"has other headings than the path, by {math.degrees(turn):.0f} deg (median), although its"
            " positions fit; check the order qx qy qz qw, and where x of the tracked body points"
        )
    return ""


def _centred(poses: Array) -> NDArray[np.complex128]:
    """Return the positions of poses (n, 3) relative to their mean, as complex numbers (n,)."""
    positions: NDArray[np.complex128] = poses[:, 0] + 1j * poses[:, 1]
    return np.asarray(positions - positions.mean(), np.complex128)


def is_same_pose(a: Array, b: Array) -> bool:
    """Return whether two poses (3,) agree within `POSE_TOLERANCE`."""
    x, y, turn = between(a, b)
    return bool(math.hypot(x, y) < POSE_TOLERANCE[0] and abs(turn) < POSE_TOLERANCE[1])


def start_frame(pairs: PosePairs, begin: float) -> Array | None:
    """Return `T_truth_map` (3,) that aligns the estimate with the true pose at the start.

    The covariance of a path is relative to its start. `begin` is the stamp of the path's first pose; if no
    true heading is known within `START_DURATION` of it, return None.
    """
    known = np.flatnonzero(np.isfinite(pairs.truth[:, 2]) & np.isfinite(pairs.estimate[:, 2]))
    if len(known) == 0 or abs(pairs.stamps[known[0]] - begin) > START_DURATION:
        return None
    return compose(pairs.truth[known[0]], inverse(pairs.estimate[known[0]]))


def position_errors(pairs: PosePairs) -> Array:
    """Return the distances (n,) m to the truth: the absolute trajectory error of each pose."""
    x, y = (pairs.estimate[:, :2] - pairs.truth[:, :2]).T
    distances: Array = np.hypot(x, y)
    return distances


def heading_errors(pairs: PosePairs) -> Array:
    """Return the signed heading errors (n,) rad; NaN if one of the headings is unknown."""
    return np.asarray(wrap(pairs.estimate[:, 2] - pairs.truth[:, 2]))


def ate(pairs: PosePairs, aligned: bool = True) -> Statistics:
    """Return the absolute trajectory error in m (Sturm et al. 2012, Eq. 3)."""
    return statistics(position_errors(pairs.aligned() if aligned else pairs))


def rpe(pairs: PosePairs, delta: float) -> tuple[Statistics, Statistics]:
    """Return the relative pose error in m and in rad over `delta` m of the true path.

    See Sturm et al. 2012, Eq. 1-2. A stretch begins at every pose and ends at the first pose at least
    delta further on. Stretches that begin without a heading have no error; if all do,
    the statistics are NaN.

    Raises
    ------
    ImpError
        If the trajectory is shorter than delta.
    """
    steps = np.hypot(*np.diff(pairs.truth[:, :2], axis=0).T)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    ends = np.searchsorted(along, along + delta * (1.0 - 1e-12))
    begins = np.flatnonzero(ends < len(along))
    if len(begins) == 0 or delta <= 0.0:
        raise ImpError(f"rpe over {delta:g} m: the trajectory has no such stretch")
    ends = ends[begins]
    true = between(pairs.truth[begins], pairs.truth[ends])
    error = between(true, between(pairs.estimate[begins], pairs.estimate[ends]))
    return statistics(np.hypot(error[:, 0], error[:, 1])), statistics(error[:, 2])
