"""What is wrong with sweeps before they are matched: left out, or told, whatever the tracker."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions, Sweeps
from impslam.health import COVERED, REPEATED, SKIPPED, Reasons
from impslam.noise import LONGEST
from impslam.sources.base import Problems
from impslam.tracking.covered import Cover, hidden_beams, no_cover
from impslam.tracking.scan_rows import Rows, first_row, judge_rows
from impslam.types import Array, Mask

TOLD = 0.2
"""Share of the valid beams that may be covered without a loss worth telling."""
MOVED = (0.2, 0.2)
"""m, rad: motion meanwhile that makes a difference."""
_REPEATED = (
    "the scan at {:.3f} s is to the bit the one before, although odometry has moved; it is left out: "
    "the lidar, its driver or the network hangs"
)
_HIDDEN = (
    "beams of the scan at {:.3f} s show what moves along with the robot; they are left out: uncover the "
    "lidar, or set sensors.*.angle_min, angle_max or range_min"
)


class Screened(NamedTuple):
    """Sweeps (m,) to be matched, what is wrong with each, and the amount that goes with it."""

    sweeps: Sweeps
    reasons: Reasons
    amounts: Array


class Screening:
    """Leaves out scans that are repeated and beams that are covered; tells of these and of gaps."""

    def __init__(self) -> None:
        self._lidars: dict[str, tuple[Rows, Cover]] = {}

    def screen(self, motions: Motions, sweeps: Sweeps, problems: Problems) -> Screened:
        """Screen the next sweeps of a sensor; `motions` are by odometry, before each."""
        m = len(sweeps)
        reasons, amounts = np.zeros(m, np.int8), np.zeros(m)
        if sweeps.scans is not None:
            sweeps = self._lidar(motions, sweeps, reasons, amounts, problems)
        skipped = _skipped(motions)
        reasons[skipped], amounts[skipped] = SKIPPED, motions.duration[skipped]
        return Screened(sweeps, reasons, amounts)

    def _lidar(
        self, motions: Motions, sweeps: Sweeps, reasons: Reasons, amounts: Array, problems: Problems
    ) -> Sweeps:
        scans, stamps = sweeps.scans, sweeps.columns.stamps
        assert scans is not None
        rows, cover = self._known(sweeps.sensor, len(scans.angles))
        hidden = hidden_beams(motions.d_pose, scans, cover)
        share = hidden.sum(axis=1) / np.maximum(scans.valid.sum(axis=1), 1)
        reasons[:] = judge_rows(stamps, scans.ranges, motions.d_pose, rows)
        repeated = reasons == REPEATED
        covered = (share > TOLD) & (reasons < COVERED)
        reasons[covered], amounts[covered] = COVERED, share[covered]
        for kind, which, words in (
            ("repeated scan", repeated, _REPEATED), ("beams covered", share > 0.0, _HIDDEN),
        ):  # fmt: skip
            if which.any():
                example = words.format(stamps[np.argmax(which)])
                problems.add(kind, example, int(which.sum()))
        hidden |= repeated[:, None]
        if not hidden.any():
            return sweeps
        return replace(sweeps, scans=replace(scans, valid=scans.valid & ~hidden))

    def _known(self, sensor: str, beams: int) -> tuple[Rows, Cover]:
        """Return what is kept of a lidar."""
        known = self._lidars.get(sensor)
        if known is None or len(known[0].ranges) != beams:
            known = self._lidars[sensor] = first_row(beams), no_cover(beams)
        return known


def _skipped(motions: Motions) -> Mask:
    """Tell which motions (m,) have come about unseen."""
    d_pose = motions.d_pose
    moved = (np.hypot(d_pose[:, 0], d_pose[:, 1]) > MOVED[0]) | (np.abs(d_pose[:, 2]) > MOVED[1])
    return np.asarray((motions.duration > LONGEST) & moved)
