"""The interface of trackers, which follow the robot from keyframe to keyframe.

A tracker works relative to the newest keyframe, so loop closures do not affect it.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import Component, parameter
from impslam.geometry.algebra import between, rotate_covariance
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.kernels import kernel
from impslam.health import (
    CARRIED,
    ELSEWHERE,
    JUMPED,
    OPPOSED,
    SLIPPED,
    STALLED,
    UNMEASURED,
    Reasons,
)
from impslam.map import Keyframe, Track
from impslam.noise import SystematicErrors
from impslam.parameters import Parameters
from impslam.sources.base import Problems
from impslam.tracking.screening import Screening
from impslam.tracking.steps import Steps, checked
from impslam.tracking.sweep_twist import unknown, with_stamps, writable
from impslam.types import Array, ErrorEstimate, Increment, Mask, SystematicPart

_CONTRADICTED = (
    "the scan at {:.3f} s shows another motion than odometry; the pose follows the scans: check "
    "encoders and wheels, or the parameters of odometry"
)
_JUMPED = (
    "the scan at {:.3f} s shows a jump that the motion before does not explain; the pose follows the "
    "scans: check whether the robot was hit or moved, or scans before it are missing"
)
_OPPOSED = (
    "up to the scan at {:.3f} s odometry and scans turn in opposite directions: check that the wheels are "
    "not swapped, and sensors.*.upside_down"
)
_CARRIED = (
    "static objects vanished or appeared at once before the scan at {:.3f} s: the robot was carried, the "
    "lidar was moved, or it looks through glass"
)


class KeyframeGate(Parameters):
    """Selects keyframes, the scans passed to the estimator: one after a distance, a turn or a time.

    Scans from one place repeat their errors (brightness of the surface, the mount, the lidar's own bias);
    treating them as independent would make the estimate overconfident. Between keyframes the pose is that
    of the tracker.
    """

    distance: float = parameter(
        0.12,
        "m",
        "a keyframe after this distance: errors of surfaces repeat over a few decimetres; inf: never",
        special="inf",
        ge=0,
    )
    angle: float = parameter(
        0.06, "rad", "or after this turn: beams hit other points; inf: never", special="inf", ge=0
    )
    seconds: float = parameter(
        0.5, "s", "or after this time, moving or not; inf: never", special="inf", ge=0
    )


class Gate(NamedTuple):
    """When a sensor's next keyframe is due.

    Attributes
    ----------
    limits : (3,) m, rad, s
    travelled : (3,) the same since its newest keyframe
    """

    limits: Array
    travelled: Array


class _Since(NamedTuple):
    """The motion from the newest keyframe to the newest reference.

    Attributes
    ----------
    pose : (3,)
    drift, error : (3, 3) covariance of the errors that add up, and of the newest match
    seconds : (1,) s, time since the newest reference
    """

    pose: Array
    drift: Array
    error: Array
    seconds: Array


class _Tracked(NamedTuple):
    """Sweeps, the motions to them by odometry, the tracker's results, and dead reckoning."""

    motions: Motions
    steps: Steps
    sweeps: Sweeps
    odometry: Array


class _Stamps(NamedTuple):
    """The stamps of m sweeps.

    Attributes
    ----------
    motions, covariances : (m, 3), (m, 3, 3) from the middle of each sweep to its stamp
    early : (m,) s by which the stamp is before the middle
    durations : (m,) s from the middle of the previous sweep to that of each
    reckoned : (m,) whether the pose at the middle is by dead reckoning
    """

    motions: Array
    covariances: Array
    early: Array
    durations: Array
    reckoned: Mask


class Tracker(Component):
    """Turns motions and sweeps into tracks; trackers differ in `steps`."""

    role: ClassVar[str] = "tracker"
    matches_scans: ClassVar[bool] = False
    """Whether `steps` finds the motion from the scans, with odometry as a prior."""

    _limits: Array = PrivateAttr()
    _motion_since_keyframe: tuple[Array, Array] = PrivateAttr()
    _since: _Since = PrivateAttr()
    _odometry: Array = PrivateAttr()
    _systematic: Sequence[SystematicErrors | None] = PrivateAttr(())
    _systematic_before: SystematicErrors | None = PrivateAttr(None)
    """Those of the newest keyframe that has any."""
    _known_errors: ErrorEstimate | None = PrivateAttr(None)
    _travelled: dict[str, Array] = PrivateAttr(default_factory=dict)
    _screening: Screening = PrivateAttr(default_factory=Screening)
    _duration: float = PrivateAttr(0.0)
    _keyframes: int = PrivateAttr(0)
    _problems: Problems = PrivateAttr(default_factory=Problems)

    def start(self, start: Array, gate: KeyframeGate) -> None:
        """Begin at a pose (3,) of the dead-reckoned path; the first sweep is a keyframe."""
        self._limits = np.array([gate.distance, gate.angle, gate.seconds])
        self._travelled = {}
        self._motion_since_keyframe = np.zeros(3), np.zeros((3, 3))
        self._since = _nothing_since()
        self._odometry = np.array(start, dtype=np.float64)
        self._duration, self._keyframes = 0.0, 0

    @property
    def problems(self) -> Problems:
        """Problems found while tracking."""
        return self._problems

    @property
    def motion_since_keyframe(self) -> tuple[Array, Array]:
        """The motion from the newest keyframe to the middle of the newest sweep: (3,) and (3, 3)."""
        return self._motion_since_keyframe

    @property
    def odometry(self) -> Array:
        """`T_odom_base` (3,) at the middle of the newest sweep, by dead reckoning."""
        return self._odometry

    def forget(self) -> None:
        """Free the memory of the maps that scans are matched with, after the end of the log."""

    @abstractmethod
    def steps(self, motions: Motions, sweeps: Sweeps, gate: Gate) -> Steps:
        """Track the next sweeps of one sensor, and add their motion to its keyframe gate.

        `motions` are by odometry, from the middle of the previous sweep to the middle of each. Scans whose
        motion is unknown may be de-skewed in place.
        """

    def learn(self, errors: ErrorEstimate | None) -> None:
        """Correct the motions since the newest keyframe by what the estimator knows of systematic errors.

        The motions between keyframes are not corrected: the estimator does that itself.
        """
        self._known_errors = errors

    def follow(
        self,
        motions: Motions,
        sweeps: Sweeps,
        systematic: Sequence[SystematicErrors | None] = (),
    ) -> Iterator[Track]:
        """Yield the tracks of these sweeps; a track cut at the end of the batch continues in the next one.

        `motions` are by odometry, from the middle of the previous sweep to the middle of each; their
        covariances do not contain the `systematic` errors of each.
        """
        self._systematic = systematic or [None] * len(sweeps)
        travelled = self._travelled.setdefault(sweeps.sensor, np.full(3, math.inf))
        sweeps, wrong, amounts, unmeasured = self._screening.screen(motions, sweeps, self._problems)
        sweeps = writable(sweeps) if self.matches_scans else sweeps
        returned = self.steps(motions, sweeps, Gate(self._limits, travelled))
        steps = checked(returned, len(sweeps), self.name)
        steps.reasons[_contradicted(steps.reasons) & unmeasured] = UNMEASURED
        steps.reasons[_contradicted(steps.reasons) & unknown(motions.covariance)] = JUMPED
        worse = wrong > steps.reasons
        steps.reasons[worse], steps.amounts[worse] = wrong[worse], amounts[worse]
        self._note_reasons(sweeps, steps.reasons)
        none_due = np.zeros(len(sweeps), np.bool_)
        for name, others in self._travelled.items():  # sensors see different things
            if name != sweeps.sensor:
                gate = Gate(np.full(3, math.inf), others)
                mark_keyframes(steps.moved, motions.duration, none_due, gate)
        odometry, at_stamp = _dead_reckon(self._odometry, motions.d_pose, sweeps.T_middle_stamp)
        self._odometry = odometry[-1] if len(odometry) else self._odometry
        sweeps = with_stamps(motions, sweeps, steps.moved)
        tracked = _Tracked(motions, steps, sweeps, at_stamp)
        begin = 0
        for end in np.flatnonzero(steps.is_keyframe).tolist():
            yield self._track(tracked, slice(begin, end), has_keyframe=True)
            begin = end + 1
        if begin < len(sweeps):
            yield self._track(tracked, slice(begin, len(sweeps)), has_keyframe=False)

    def _note_reasons(self, sweeps: Sweeps, reasons: Reasons) -> None:
        """Add to the problems the sweeps with some of these reasons (m,)."""
        for kind, message, which in (
            ("turns against scans", _OPPOSED, reasons == OPPOSED),
            ("odometry against scans", _CONTRADICTED, _contradicted(reasons)),
            ("motion jumps", _JUMPED, reasons == JUMPED),
            ("robot carried", _CARRIED, reasons == CARRIED),
        ):
            for stamp in sweeps.columns.stamps[which].tolist():
                self._problems.add(kind, message.format(stamp))

    def _track(self, tracked: _Tracked, rows: slice, *, has_keyframe: bool) -> Track:
        """Return the track of some rows.

        With `has_keyframe`, the row after them is the keyframe that ends it.
        """
        motions, steps, sweeps, odometry = tracked
        stop = rows.stop + 1 if has_keyframe else rows.stop
        part = slice(rows.start, stop)
        T, spread, T_stamp, spread_stamp = _accumulate(
            self._since,
            Steps._make(column[part] for column in steps),
            self._stamps(motions.duration[part], sweeps, steps.reference, part),
        )
        elapsed = self._duration + np.cumsum(motions.duration[rows])
        for k, systematic in enumerate(self._systematic[rows]):
            if systematic is not None:
                errors = systematic.errors(T_stamp[k], elapsed[k])
                self._add_systematic(errors, T_stamp[k], spread_stamp[k])
        self._duration += float(motions.duration[rows.start : stop].sum())
        m, keyframe = rows.stop - rows.start, None
        if has_keyframe:
            keyframe = self._keyframe(tracked, rows.stop, T[m], spread[m])
            self._motion_since_keyframe, self._duration = (np.zeros(3), np.zeros((3, 3))), 0.0
            self._since = _nothing_since()
        elif m:
            self._motion_since_keyframe = T[m - 1], spread[m - 1]
        track = Track(
            self._keyframes - 1,
            sweeps.columns.stamps[rows],
            T_stamp[:m],
            spread_stamp[:m],
            odometry[rows],
            sweeps,
            rows,
            steps.located[rows],
            steps.reasons[rows],
            steps.amounts[rows],
            keyframe,
        )
        self._keyframes += has_keyframe
        return track

    def _stamps(self, durations: Array, sweeps: Sweeps, reference: Mask, part: slice) -> _Stamps:
        """Return the stamps of some rows, with the durations (r,) of the motions to them."""
        return _Stamps(
            sweeps.T_middle_stamp[part],
            sweeps.stamp_covariance[part],
            (sweeps.middles - sweeps.columns.stamps)[part],
            durations,
            ~reference[part] if self.matches_scans else np.ones(len(durations), np.bool_),
        )

    def _add_systematic(self, errors: Array, d_pose: Array, covariance: Array) -> None:
        """Correct a motion (3,) by what is known of its systematic errors (3, k); widen its covariance."""
        sigmas, known = np.ones(errors.shape[1]), self._known_errors
        if known is not None:
            count = min(len(known.means), len(sigmas))
            d_pose += errors[:, :count] @ known.means[:count]
            sigmas[:count] = known.sigmas[:count]
        errors = errors * sigmas
        covariance += errors @ errors.T

    def _keyframe(self, tracked: _Tracked, row: int, d_pose: Array, covariance: Array) -> Keyframe:
        """Return the keyframe in a row, with the motion from the previous keyframe."""
        motions, steps, sweeps, odometry = tracked
        stamp, reason, part = float(motions.stamps[row]), int(steps.reasons[row]), None
        systematic = self._systematic[row]
        if systematic is not None:
            replaced = np.zeros((3, 3))
            replaced[2, 2] = systematic.turn_variances(d_pose, self._duration)
            errors = systematic.errors(d_pose, self._duration)
            correlation = systematic.correlation(self._systematic_before or systematic)
            part = SystematicPart(errors, replaced, correlation, systematic.learned)
            covariance = covariance + replaced
            self._systematic_before = systematic
        return Keyframe(
            id=self._keyframes,
            stamp=float(sweeps.columns.stamps[row]),
            motion=Increment(stamp, d_pose, covariance, self._duration, part),
            odometry=odometry[row],
            T_keyframe_stamp=sweeps.T_middle_stamp[row],
            stamp_covariance=sweeps.stamp_covariance[row],
            sweeps=sweeps,
            row=row,
            located=bool(steps.located[row]),
            lost=reason == ELSEWHERE or (reason == CARRIED and self.matches_scans),
            reason=reason,
            amount=float(steps.amounts[row]),
            reach=(float(steps.reach[row, 0]), float(steps.reach[row, 1])),
        )


def _contradicted(reasons: Reasons) -> Mask:
    """Return for which sweeps the scans contradict odometry."""
    return (reasons >= SLIPPED) & (reasons <= STALLED)


@kernel
def reaches_limit(gate: Gate, d_pose: Array, duration: float) -> bool:
    """Return whether a motion (3,) of `duration` s would reach a limit of the gate."""
    travelled = gate.travelled
    far = travelled[0] + math.hypot(d_pose[0], d_pose[1]) >= gate.limits[0]
    turned_far = travelled[1] + abs(d_pose[2]) >= gate.limits[1]
    return bool(far or turned_far or travelled[2] + duration >= gate.limits[2])


@kernel
def add_travel(gate: Gate, d_pose: Array, duration: float) -> None:
    """Add a motion (3,) of `duration` s to the gate."""
    gate.travelled[0] += math.hypot(d_pose[0], d_pose[1])
    gate.travelled[1] += abs(d_pose[2])
    gate.travelled[2] += duration


@kernel
def mark_keyframes(moved: Array, duration: Array, due: Mask, gate: Gate) -> Mask:
    """Add motions (m, 3) to the gate; return which of them end in a keyframe, (m,).

    These are the ones that reach a limit, and those that are `due` (m,) anyway.
    """
    out = np.zeros(len(moved), np.bool_)
    for k in range(len(moved)):
        out[k] = due[k] or reaches_limit(gate, moved[k], duration[k])
        add_travel(gate, moved[k], duration[k])
        if out[k]:
            gate.travelled[:] = 0.0
    return out


def _nothing_since() -> _Since:
    return _Since(np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(1))


@kernel
def _dead_reckon(start: Array, d_pose: Array, T_middle_stamp: Array) -> tuple[Array, Array]:
    """Return the poses (m, 3) of odometry at the middles of m sweeps, and at their stamps."""
    middles, stamps = np.empty((len(d_pose), 3)), np.empty((len(d_pose), 3))
    pose = start.copy()
    for k in range(len(d_pose)):
        advance_pose(pose, d_pose[k])
        middles[k] = stamps[k] = pose
        advance_pose(stamps[k], T_middle_stamp[k])
    return middles, stamps


@kernel
def _accumulate(since: _Since, steps: Steps, stamps: _Stamps) -> tuple[Array, Array, Array, Array]:
    """Return m poses and covariances at the middles of sweeps, and at the stamps.

    Each motion follows the newest reference before it; `since` is the motion to the first of these, and
    becomes that to the last.
    """
    m = len(steps.d_pose)
    poses, spreads = np.empty((m, 3)), np.empty((m, 3, 3))
    at_stamp, spreads_at_stamp = np.empty((m, 3)), np.empty((m, 3, 3))
    for k in range(m):
        begin, spread = since.pose.copy(), since.drift + since.error
        since.seconds[0] += stamps.durations[k]
        seconds = since.seconds[0]
        if steps.reference[k]:
            since.error[:] = rotate_covariance(steps.error[k], since.pose[2])
            advance(since.pose, since.drift, steps.d_pose[k], steps.covariance[k])
            since.seconds[0] = 0.0
        poses[k], spreads[k] = since.pose, since.drift + since.error
        if not steps.reference[k]:
            advance(poses[k], spreads[k], steps.d_pose[k], steps.covariance[k])
        at_stamp[k], spreads_at_stamp[k] = poses[k], spreads[k]
        advance(at_stamp[k], spreads_at_stamp[k], stamps.motions[k], stamps.covariances[k])
        if stamps.reckoned[k] and 0.0 < stamps.early[k] <= seconds:
            share = 1.0 - stamps.early[k] / seconds
            _advance_to(begin, spread, at_stamp[k], share * steps.covariance[k])
            spreads_at_stamp[k] = spread
    return poses, spreads, at_stamp, spreads_at_stamp


@kernel
def _advance_to(pose: Array, P: Array, end: Array, Q: Array) -> None:
    """Compose pose (3,) and P (3, 3) with a motion of covariance Q (3, 3) to an end (3,), in place.

    The path to a stamp before the middle of a sweep is a part of that to the middle: its errors would count
    twice if it were the one to the middle and back.
    """
    motion = np.empty(3)
    between(pose, end, motion)
    advance(pose, P, motion, Q)
