"""Whether the pose of a scan can be trusted: codes of reasons, and their descriptions.

The codes are ordered: of several reasons that apply to a scan, the greatest one is reported.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from impslam.types import Array, Increment

Reasons = np.ndarray[Any, np.dtype[np.int8]]

TRACKING, DEGRADED, LOST = range(3)
STATES = ("TRACKING", "DEGRADED", "LOST")
"""The states of a pose.

TRACKING: the pose is within its covariance. DEGRADED: it is the best estimate, but part of its basis
has failed. LOST: it may be anywhere; the map does not change.
"""
(
    NONE,
    MISALIGNED,
    MISSCALED,
    MISTIMED,
    DISTORTED,
    OPEN,
    BLIND,
    COVERED,
    DISORDERED,
    REPEATED,
    SLIPPED,
    PUSHED,
    STALLED,
    JUMPED,
    UNMEASURED,
    OPPOSED,
    SKIPPED,
    CHANGED,
    CARRIED,
    DRIFTING,
    INCONSISTENT,
    GROWN,
    DISPLACED,
    AMBIGUOUS,
    ASSUMED,
    CONTRADICTED,
    UNEXPLAINED,
    ELSEWHERE,
    UNPLACED,
    NOT_FINITE,
) = range(30)
"""The reasons. `OPEN` and `GROWN` come with a distance in m, `MISTIMED`, `DISTORTED` and `SKIPPED` with s,
`MISALIGNED` with degrees, `INCONSISTENT` with a ratio; `MISSCALED`, `COVERED`, `CHANGED`, `CARRIED`,
`UNEXPLAINED` and `ELSEWHERE` with a share."""
_DESCRIPTIONS = (
    "",
    "the lidar is rotated by {0:.1f} deg relative to its configured mount; the heading is off by as much",
    "odometry and ranges differ by {1:.1f} % in scale; distances are uncertain by as much",
    "scans are stamped {0:.2f} s late or early on the clock of odometry; the pose is for another time",
    "the beams of a scan are timed wrongly, by {0:.2f} s from the first to the last; turns distort the map",
    "no feature along the corridor for {0:.1f} m",
    "the lidar sees nothing; the pose is dead-reckoned",
    "{1:.0f} % of the beams hit something that moves with the robot; they are left out",
    "stamps of scans jump back and forth: which motion belongs to a scan is uncertain",
    "the lidar repeats one scan while odometry moves; the pose is dead-reckoned",
    "the scans show another motion than odometry; the pose follows the scans",
    "the robot moves, the wheels do not; the pose follows the scans",
    "the wheels turn, the robot does not; the pose follows the scans",
    "the scans show a jump that the motion before does not explain; the pose follows the scans",
    "odometry is missing, or has just returned; the pose follows the scans",
    "odometry and scans turn in opposite directions: wheels are swapped, or the lidar is mirrored",
    "no data of odometry or of sensors for {0:.0f} s, and the robot has moved; the position is uncertain",
    "{1:.0f} % of the scan has changed at once; the position is uncertain",
    "{1:.0f} % of the scan has changed at once, as if the robot was carried; the position is uncertain",
    "landmarks keep correcting odometry in one direction: the wheels slip, or parameters are wrong",
    "landmarks are {0:.1f} times as far from their positions as expected; the position is uncertain",
    "no known feature was seen for {0:.1f} m; the position is uncertain",
    "most observations match no earlier landmark; the position is uncertain",
    "the scans also fit other places within the uncertainty; the robot may be at one of them",
    "tracking was lost; the path since then is from odometry alone, as no earlier place is recognised",
    "the scans contradict what was seen here earlier; the robot may be elsewhere",
    "only {1:.0f} % of the scan fits the map; the map is not updated",
    "only {1:.0f} % of the scan fits the map: the robot is elsewhere",
    "the robot's position in the map is not known yet",
    "the estimate is not finite; start a new map",
)
_SHARES = (UNEXPLAINED, ELSEWHERE)
MAX_GROWTH = 0.25
"""m, growth of the position's standard deviation beyond which landmarks in a room may be confused: they are
0.5 m or more apart."""


class LogFault(NamedTuple):
    """A fault of a log that affects all poses: a reason (`NONE` without a fault) and its amount."""

    reason: int = NONE
    amount: float = 0.0


NO_FAULT = LogFault()
"""A log without such a fault."""


class Span(NamedTuple):
    """Consecutive scans with one reason.

    Attributes
    ----------
    begin, end : s, stamps of the first and the last scan
    reason, amount : the reason, and its worst amount
    scans : number of scans
    """

    begin: float
    end: float
    reason: int
    amount: float
    scans: int

    @property
    def state(self) -> str:
        """The name of the state."""
        return STATES[state_of(self.reason)]

    @property
    def description(self) -> str:
        """The reason in words."""
        return describe(self.reason, self.amount)


class Health(NamedTuple):
    """Health of n scans.

    Attributes
    ----------
    stamps : (n,) s, those of the log
    reasons : (n,) int8, why each pose cannot be trusted; `NONE` if it can
    amounts : (n,) the amount that the reason comes with, else 0
    silent : s after the last scan in which the robot has moved on, see `silent_time`; else 0
    """

    stamps: Array
    reasons: Reasons
    amounts: Array
    silent: float = 0.0

    @property
    def states(self) -> Reasons:
        """(n,) `TRACKING`, `DEGRADED` or `LOST`."""
        return np.where(self.reasons == NONE, TRACKING, DEGRADED).astype(np.int8) + (
            self.reasons >= ELSEWHERE
        )

    def counts(self) -> dict[str, int]:
        """Return the number of scans in each state."""
        return dict(zip(STATES, np.bincount(self.states, minlength=3).tolist(), strict=True))

    @property
    def at_end(self) -> str:
        """The name of the state at the end; without scans, the pose there is at best dead-reckoned."""
        newest = state_of(int(self.reasons[-1])) if len(self.reasons) else TRACKING
        return STATES[max(newest, DEGRADED) if self.silent else newest]

    @property
    def needs_inspection(self) -> bool:
        """Whether a mount, a clock or a scale seems wrong: `imp inspect` measures them."""
        measured = MISALIGNED, MISSCALED, MISTIMED, DISTORTED
        return bool(np.isin(self.reasons, measured).any())

    def spans(self) -> Iterator[Span]:
        """Yield the spans of scans that cannot be trusted, in order."""
        for a, b in self._stretches():
            reason, amounts = int(self.reasons[a]), self.amounts[a:b]
            worst = amounts.min() if reason in _SHARES else amounts.max()
            span = float(self.stamps[a]), float(self.stamps[b - 1])
            yield Span(*span, reason, float(worst), b - a)

    def _stretches(self) -> Iterator[tuple[int, int]]:
        """Yield the first scan of each span, and the one after its last."""
        edges = np.flatnonzero(np.diff(self.reasons, prepend=-1, append=-1))
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if self.reasons[a] != NONE:
                yield a, b

    @property
    def summary(self) -> str:
        """One line for the report and the terminal."""
        spans = list(self.spans())
        line = self._course(spans)
        if self.silent:
            why = f"no scan in the last {self.silent:.0f} s, while the robot moves on"
            return f"{line}; at the end {self.at_end}: {why}"
        if not spans or spans[0].scans == len(self.stamps):
            return line
        if self.reasons[-1] == NONE:
            return line + "; TRACKING at the end"
        return line + f"; at the end {spans[-1].state}: {spans[-1].description}"

    def _course(self, spans: Sequence[Span]) -> str:
        """Return the states of all scans, and the longest span in words."""
        if not spans:
            return "TRACKING throughout"
        if spans[0].scans == len(self.stamps):
            return f"{spans[0].state} throughout: {spans[0].description}"
        counts = self.counts()
        line = ", ".join(f"{state} at {counts[state]} scans" for state in STATES if counts[state])
        k = max(range(len(spans)), key=lambda k: (spans[k].reason >= ELSEWHERE, spans[k].scans))
        first = list(self._stretches())[k][0]
        begin = float(np.fmax(np.diff(self.stamps[: first + 1]), 0.0).sum())  # clocks may step back
        return f"{line}; the longest begins {begin:.1f} s after the start: {spans[k].description}"


def silent_time(ahead: Increment) -> float:
    """Return the duration of the motion after the last scan, s, or 0 if it hardly changes the position.

    That is if it increases the position's standard deviation by at most `MAX_GROWTH`.
    """
    variance = float(ahead.covariance[0, 0] + ahead.covariance[1, 1])
    is_known = ahead.duration > 0.0  # not NaN, as with unusable stamps
    return ahead.duration if is_known and variance > MAX_GROWTH**2 else 0.0


def state_of(reason: int) -> int:
    """Return the state of a pose with this reason."""
    return LOST if reason >= ELSEWHERE else DEGRADED if reason else TRACKING


def describe(reason: int, amount: float) -> str:
    """Return the description of a reason, "" for `NONE`."""
    return _DESCRIPTIONS[reason].format(amount, 100.0 * amount)


NO_SCANS = Health(np.empty(0), np.empty(0, np.int8), np.empty(0))
