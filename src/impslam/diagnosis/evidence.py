"""Data that the checks share: motions by the laser and by odometry, over the same stretches of time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath, lidar_path, undistorted, unmounted
from impslam.calibration.order_clock import MAX_DISORDER, reorder_stamps
from impslam.calibration.recording import CalibrationRows, lidars_of
from impslam.columns import Columns
from impslam.config import Config
from impslam.diagnosis.agreement import (
    MIN_STRETCHES,
    Agreement,
    Axis,
    axis_by_odometry,
    drive_axis,
    fit_agreement,
)
from impslam.diagnosis.aligned_pairs import AlignedPairs
from impslam.diagnosis.beam_samples import BeamSamples, beam_samples
from impslam.diagnosis.file_order import in_file_order, without_repeats
from impslam.diagnosis.timing import Timing, estimate_timing, no_timing
from impslam.diagnosis.travel import Odometer, SweepMotions, make_odometer, stretches, sweep_motions
from impslam.odometry.base import Odometry
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Ints

FULL_VIEW = 6.0
"""rad: a lidar with this field of view sees the same surfaces in any heading."""
MAX_SIDEWAYS = 0.1
"""Largest ratio of sideways to forward distance by odometry of a robot with an axle."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Input of the checks, computed from a log.

    Attributes
    ----------
    config, name, lidar, odometry : the config, one of its lidars with its name, its odometry
    recording : the rows of the log; with times by their order if it is `untimed`, or if its stamps run back
        and the turns by laser and by odometry agree better by order
    path : the lidar's path by its scans alone
    pairs : pairs of scans along it
    samples : scans to check beams with; None if there are too few
    sweep_motions : the motions along it, with stamps as received
    timing : when scans were taken
    sweep_time : s, median duration of the sweeps by their beams' times; negative if the last beam is first
    times : (k, 2) s, begin and end of stretches on the odometry's clock, where both are known
    lidar_motion, odometry_motion : (k, 3) twists over the stretches, of the laser and of base_link
    resolution : (3,) of odometry, m, m, rad; see `Odometer`
    axis : driving direction, from the laser, or by odometry if that moves sideways; None if unknown
    axle_motion : (k, 2) m, rad: motion of the axle by the laser, in the sense of `axis`
    agreement : fit of odometry to that; None if there is no axis
    odometry_total : m + rad, all motion by odometry, also where the laser's is unknown
    is_alone : whether the robot has no other lidar
    is_odometry_confirmed : whether odometry drives and turns as another lidar does
    """

    config: Config
    name: str
    lidar: Lidar2D
    odometry: Odometry
    recording: CalibrationRows
    path: LidarPath
    pairs: AlignedPairs
    samples: BeamSamples | None
    sweep_motions: SweepMotions
    timing: Timing
    sweep_time: float
    times: Array
    lidar_motion: Array
    odometry_motion: Array
    resolution: Array
    axis: Axis | None
    axle_motion: Array
    agreement: Agreement | None
    odometry_total: float
    is_alone: bool
    is_odometry_confirmed: bool = False

    @property
    def untimed(self) -> bool:
        """Whether the log has no usable times; findings that need them are not made."""
        return self.recording.untimed

    @property
    def view(self) -> float:
        """The widest field of view of the lidar's scans, rad."""
        return max((float(np.ptp(piece["angles"])) for piece in self.recording.scans), default=0.0)

    @property
    def lidar_key(self) -> str:
        """The lidar's table in the config."""
        return f"sensors.{self.name}"

    @property
    def matches_scans(self) -> bool:
        """Whether a run matches scans and uses odometry only as an initial guess."""
        return self.config.make_tracker().matches_scans

    @property
    def odometry_moves(self) -> bool:
        """Whether odometry reports any motion over the stretches, apart from noise."""
        moves = bool((np.abs(self.odometry_motion[:, [0, 2]]) > 1e-6).any())
        return moves and not (self.agreement is not None and self.agreement.is_noise)

    @property
    def drives_ahead(self) -> bool:
        """Whether odometry reports more motion ahead than sideways."""
        ahead, sideways, _ = np.abs(self.odometry_motion).sum(axis=0)
        return bool(ahead >= sideways)

    @property
    def is_mount_given(self) -> bool:
        """Whether the config, or the log for it, gives the laser's mount."""
        return "mount" in self.config.sensors[self.name]


def gather_evidence(config: Config, name: str, recording: CalibrationRows) -> Evidence:
    """Compare the motions of the lidar with this name in a recording with odometry."""
    robot = config.make_robot()
    lidars = lidars_of(robot)
    lidar = lidars[name]
    recording, path, sweeps, odometer, timing = _best_motions(robot.odometry, lidar, recording)
    samples = beam_samples(lidar, recording.scans, path)
    begins, ends = _known_stretches(sweeps, odometer, timing.stamps)
    times = np.column_stack((timing.stamps[begins], timing.stamps[ends]))
    sums = np.cumsum(sweeps.twists, axis=0)
    lidar_motion = sums[ends] - sums[begins]
    odometry_motion = odometer.between(times) if len(times) else lidar_motion
    axis, resolution = _axis(lidar_motion, odometry_motion, lidar), odometer.resolution
    axle_motion, agreement = np.empty((0, 2)), None
    if axis is not None:
        axle_motion = motion_along(lidar_motion, axis.angle)
        agreement = fit_agreement(axle_motion, odometry_motion, resolution)
        if axis.has_axle and agreement.is_reversed:
            axis = axis.flipped()
            axle_motion = motion_along(lidar_motion, axis.angle)
            agreement = fit_agreement(axle_motion, odometry_motion, resolution)
    return Evidence(
        config, name, lidar, robot.odometry, recording, path, AlignedPairs(recording.scans, path),
        samples, sweeps, timing, _sweep_time(lidar, recording.scans), times, lidar_motion,
        odometry_motion, resolution, axis, axle_motion, agreement, _total(odometer), len(lidars) == 1,
    )  # fmt: skip


class _Motions(NamedTuple):
    """A recording, the path by its scans, the motions by laser and by odometry, and their timing."""

    recording: CalibrationRows
    path: LidarPath
    sweeps: SweepMotions
    odometer: Odometer
    timing: Timing


def _best_motions(odometry: Odometry, lidar: Lidar2D, recording: CalibrationRows) -> _Motions:
    """Return the motions by the stamps, or by the order of the log where that is the better clock."""
    if recording.untimed:
        return _motions(odometry, lidar, in_file_order(recording), 0.0)
    found = _motions(odometry, lidar, recording, 0.0)
    ordered, disorder = reorder_stamps(without_repeats(recording))
    if disorder <= MAX_DISORDER:
        return found
    by_order = _motions(odometry, lidar, ordered, disorder)
    return by_order if by_order.timing.fits_better(found.timing) else found


def _motions(
    odometry: Odometry, lidar: Lidar2D, recording: CalibrationRows, disorder: float
) -> _Motions:
    path = lidar_path(lidar, recording.scans)
    sweeps = sweep_motions(undistorted(lidar, recording.scans, path))
    odometer = make_odometer(odometry, recording.odometry if odometry.measures_motion else ())
    if recording.untimed:
        return _Motions(recording, path, sweeps, odometer, no_timing(sweeps))
    timing = estimate_timing(sweeps, odometer, lidar, disorder)
    return _Motions(recording, path, sweeps, odometer, timing)


def confirmed(every: Sequence[Evidence]) -> list[Evidence]:
    """Return the evidence of all lidars, each with whether another one confirms odometry."""
    alike = [e.agreement is not None and e.agreement.is_alike for e in every]
    return [
        replace(e, is_odometry_confirmed=any(alike[:k] + alike[k + 1 :]))
        for k, e in enumerate(every)
    ]


def _sweep_time(lidar: Lidar2D, scans: Sequence[Columns]) -> float:
    """Return the median duration of the sweeps, s, by their beams' times; negative if the last is first.

    Drivers that measure the time of a revolution double it when they lose one, so the longest sweep says
    little.
    """
    spans = [unmounted(lidar).spans(piece) for piece in scans]
    every = np.concatenate([ends - begins for begins, ends in spans]) if spans else np.zeros(1)
    return float(np.median(every)) * (-1.0 if lidar.last_beam_first else 1.0)


def _total(odometer: Odometer) -> float:
    return float(np.abs(np.diff(odometer.sums[:, [0, 2]], axis=0)).sum())


def motion_along(twists: Array, angle: float) -> Array:
    """Return the distance along a beam angle and the turn, (k, 2) m, rad, of the laser's twists (k, 3)."""
    return np.column_stack((twists[:, :2] @ [math.cos(angle), math.sin(angle)], twists[:, 2]))


def motion_by(odometry: Odometry, rows: Sequence[Columns], times: Array) -> Array:
    """Return the motions (k, 3) over the stretches by another odometry."""
    return make_odometer(odometry, rows).between(times)


def _known_stretches(motion: SweepMotions, odometer: Odometer, stamps: Array) -> tuple[Ints, Ints]:
    begins, ends = stretches(motion)
    if not len(odometer.stamps):
        return begins[:0], ends[:0]
    whole = odometer.is_whole(stamps[begins], stamps[ends])
    return begins[whole], ends[whole]


def _axis(lidar_motion: Array, odometry_motion: Array, lidar: Lidar2D) -> Axis | None:
    """Return the axis; if odometry does not tell its sense, in the sense closer to the config's."""
    if len(lidar_motion) < MIN_STRETCHES:
        return None
    sideways, forward = np.abs(odometry_motion[:, 1]).sum(), np.abs(odometry_motion[:, 0]).sum()
    if sideways > MAX_SIDEWAYS * forward + 0.1:
        return axis_by_odometry(lidar_motion, odometry_motion)
    axis = drive_axis(lidar_motion)
    expected = -lidar.mount[2]  # the beam angle that points ahead
    if math.cos(axis.angle - expected) < 0.0:
        axis = axis.flipped()
    return axis
