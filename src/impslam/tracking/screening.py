"""Screen sweeps before any tracker uses them: leave out repeated scans and covered beams, report gaps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions, Sweeps
from impslam.geometry.kernels import kernel
from impslam.health import COVERED, NONE, REPEATED, SKIPPED, Reasons
from impslam.noise import MAX_GAP
from impslam.sources.base import Problems
from impslam.tracking.covered import Cover, hidden_beams, initial_cover
from impslam.tracking.intervals import add_interval, is_gap, no_intervals
from impslam.tracking.per_lidar import PerLidar
from impslam.tracking.scan_stream import StreamState, check_stream, initial_stream_state
from impslam.types import Array, Mask

MAX_COVERED = 0.2
"""Share of the valid beams; if more are covered, this is a reason for degraded health."""
MIN_MOTION = (0.2, 0.2)
"""m, rad: motion during a gap that matters."""
MAX_SILENCE = 1.0
"""s for which sweeps may come without odometry: sweeps wait for it, and slow odometry has 1 Hz."""
MIN_SILENT_SWEEPS = 3
"""Sweeps that must come in that time: a single stamp may jump."""
MAX_UNMEASURED = MAX_SILENCE / MIN_SILENT_SWEEPS
"""s without odometry after which a difference between odometry and scans means that odometry is missing."""
RECOVERY = 3.0
"""s after that for which it still does: the time over which odometry and scans are compared."""
SILENT = "odometry missing"
_REPEATED = (
    "the scan at {:.3f} s equals the one before bit for bit, although odometry has moved; it is left out: "
    "the lidar, its driver or the network hangs"
)
_COVERED = (
    "beams of the scan at {:.3f} s hit something that moves with the robot; they are left out: uncover the "
    "lidar, or set sensors.*.angle_min, angle_max or range_min"
)

_SILENT = "no odometry for the scans {}: check its driver, its connection and its stamps"
# State of `_find_gaps` before the first sweep.
_NO_SILENCE = np.array([math.inf, 0.0, 0.0, math.inf])


class Screened(NamedTuple):
    """Sweeps (m,) to be matched.

    Attributes
    ----------
    sweeps : without repeated scans and covered beams
    reasons, amounts : (m,) what is wrong with each
    unmeasured : (m,) whether odometry is missing, or was until shortly before
    """

    sweeps: Sweeps
    reasons: Reasons
    amounts: Array
    unmeasured: Mask


class Screening:
    """Leaves out repeated scans and covered beams; reports these and gaps."""

    def __init__(self) -> None:
        self._lidars = PerLidar(_no_scans)
        self._intervals: dict[str, Array] = {}  # see `_find_gaps`, for each sensor
        self._silence = _NO_SILENCE.copy()  # of odometry, for all sensors together
        self._is_first_silence = False  # whether the first silence of odometry goes on

    def screen(self, motions: Motions, sweeps: Sweeps, problems: Problems) -> Screened:
        """Screen the next sweeps of a sensor; `motions` are by odometry, before each."""
        m = len(sweeps)
        reasons, amounts = np.zeros(m, np.int8), np.zeros(m)
        if sweeps.scans is not None:
            sweeps = self._screen_lidar(motions, sweeps, reasons, amounts, problems)
        intervals = self._intervals.setdefault(sweeps.sensor, no_intervals())
        silence = float(self._silence[1])
        gaps, silences, unmeasured = _find_gaps(motions, intervals, self._silence)
        self._report(sweeps.columns.stamps, np.append(silence, silences), problems)
        skipped = gaps > 0.0
        reasons[skipped], amounts[skipped] = SKIPPED, gaps[skipped]
        return Screened(sweeps, reasons, amounts, unmeasured)

    def _report(self, stamps: Array, silences: Array, problems: Problems) -> None:
        """Record silences of odometry; `silences` (m + 1,) begin with that before the sweeps."""
        now = silences[1:]
        for k in np.flatnonzero((now > MAX_SILENCE) & (silences[:-1] <= MAX_SILENCE)).tolist():
            self._is_first_silence |= SILENT not in problems.counts
            problems.add(SILENT, _SILENT.format(f"after {stamps[k] - now[k]:.3f} s"))
        for k in np.flatnonzero(now < -MAX_SILENCE).tolist():
            if self._is_first_silence:
                span = f"from {stamps[k] + now[k]:.3f} to {stamps[k]:.3f} s"
                problems.examples[SILENT], self._is_first_silence = _SILENT.format(span), False

    def _screen_lidar(
        self, motions: Motions, sweeps: Sweeps, reasons: Reasons, amounts: Array, problems: Problems
    ) -> Sweeps:
        scans, stamps = sweeps.scans, sweeps.columns.stamps
        assert scans is not None
        stream, cover = self._lidars.get(sweeps.sensor, len(scans.angles))
        hidden = hidden_beams(motions.d_pose, scans, cover)
        share = hidden.sum(axis=1) / np.maximum(scans.valid.sum(axis=1), 1)
        reasons[:] = check_stream(stamps, scans.ranges, motions.d_pose, stream)
        # Empty scans are equal; that the lidar sees nothing is reported elsewhere.
        reasons[(reasons == REPEATED) & ~scans.valid.any(axis=1)] = NONE
        repeated = reasons == REPEATED
        covered = (share > MAX_COVERED) & (reasons < COVERED)
        reasons[covered], amounts[covered] = COVERED, share[covered]
        for kind, which, message in (
            ("repeated scan", repeated, _REPEATED), ("beams covered", share > 0.0, _COVERED),
        ):  # fmt: skip
            if which.any():
                example = message.format(stamps[np.argmax(which)])
                problems.add(kind, example, int(which.sum()))
        hidden |= repeated[:, None]
        if not hidden.any():
            return sweeps
        return replace(sweeps, scans=replace(scans, valid=scans.valid & ~hidden))


def _no_scans(beams: int) -> tuple[StreamState, Cover]:
    """Return the state of a lidar with this number of beams before its first scan."""
    return initial_stream_state(beams), initial_cover(beams)


@kernel
def _find_gaps(motions: Motions, intervals: Array, state: Array) -> tuple[Array, Array, Mask]:
    """Return the gap (m,) s in the data before each sweep in which the robot has moved; 0 without one.

    It is a gap in all data, or in odometry alone, in which the robot may have gone on at its last speed.
    Also return the time (m,) s since odometry, negative at the sweep where it returns, and whether
    odometry is missing or was until shortly before (m,).

    These are updated: `intervals`, see `no_intervals`; `state` (4,), the middle of the last sweep, s, the
    time since the last odometry, s, the speed then, in multiples of `MIN_MOTION` per s, and the time since
    odometry returned, s.
    """
    out, silences = np.zeros(len(motions.stamps)), np.zeros(len(motions.stamps))
    unmeasured = np.zeros(len(out), np.bool_)
    for k in range(len(out)):
        x, y, turn = motions.d_pose[k]
        moved = max(math.hypot(x, y) / MIN_MOTION[0], abs(turn) / MIN_MOTION[1])
        seconds, elapsed = motions.duration[k], motions.stamps[k] - state[0]
        step = min(max(elapsed, 0.0), MAX_UNMEASURED)
        state[3] += step
        if seconds > 0.0:
            if state[1] > MAX_UNMEASURED:
                silences[k], state[3] = -(state[1] + step), 0.0
            state[1], state[2] = 0.0, moved / seconds
        else:
            state[1] += step
            silences[k] = state[1]
        unmeasured[k] = state[1] > MAX_UNMEASURED or state[3] < RECOVERY
        if moved > 1.0 and is_gap(seconds, intervals, MAX_GAP):
            out[k] = seconds
        elif state[1] > MAX_SILENCE and state[1] * state[2] > 1.0:
            out[k] = state[1]
        add_interval(seconds, intervals, MAX_GAP)
        state[0] = motions.stamps[k]
    return out, silences, unmeasured
