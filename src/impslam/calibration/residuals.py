"""Residuals of odometry and mount against a lidar's motions, and their derivatives.

If base_link moves by z (complex, see `odometry_models`) and turns by f, a lidar at m with yaw psi, whose
ranges must be scaled by s, moves by L = exp(-i psi) (z + (exp(i f) - 1) m) / s and turns by f. Residuals
are [Re L, Im L, f, o] minus `LidarMotions.joint`, with o the range offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impslam.calibration.gyro import GyroCalibration
from impslam.calibration.lidar_path import LidarPath
from impslam.calibration.odometry_models import Complex, Motion, OdometryModel, motion
from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.angles import wrap
from impslam.types import Array

LIDAR_PARAMETERS = ("x", "y", "yaw", "latency", "range_offset", "range_scale")
"""Calibrated parameters of the lidar, following those of odometry: m, m, rad, s, m, 1."""


@dataclass(frozen=True, eq=False)
class CalibrationDrive:
    """One log: odometry readings with their model, the lidar's motions and path, and errors of a gyro.

    `disorder` is the amount by which its stamps run back, s rms: no latency is known better.
    """

    model: OdometryModel
    motions: LidarMotions
    path: LidarPath | None = None
    gyro: GyroCalibration | None = None
    disorder: float = 0.0


class Residuals(NamedTuple):
    """Residuals (k, 4) of one drive and their derivatives (k, 4, p + 6) by all parameters."""

    values: Array
    by_all: Array


def residuals(drive: CalibrationDrive, parameters: Array) -> Residuals:
    """Return the residuals for parameters (p + 6,): those of odometry, then `LIDAR_PARAMETERS`."""
    found, p = drive.motions, len(drive.model.names)
    x, y, yaw, latency, offset, scale = parameters[p:]
    base = motion(drive.model, parameters[:p], latency, found.begins, found.ends)
    L, L_D = _seen(base, complex(x, y), yaw, scale)
    k = len(L)
    e, J = np.empty((k, 4)), np.zeros((k, 4, p + len(LIDAR_PARAMETERS)))
    e[:, 0], e[:, 1], e[:, 2], e[:, 3] = L.real, L.imag, base.turn, offset
    e -= found.joint
    e[:, 2] = wrap(e[:, 2])
    J[:, 0], J[:, 1] = L_D.real, L_D.imag
    J[:, 2, :p], J[:, 2, p + 3] = base.turn_D[:, :p], base.turn_D[:, p]
    J[:, 3, p + 4] = 1.0
    return Residuals(e, J)


def _seen(base: Motion, m: complex, yaw: float, scale: float) -> tuple[Complex, Complex]:
    """Return the lidar's translations (k,), complex, in its frame, and their derivatives (k, p + 6)."""
    turned = np.exp(1j * base.turn)
    into = np.exp(-1j * yaw) / scale
    L = into * (base.translation + (turned - 1.0) * m)
    by_base = into * (base.translation_D + 1j * (turned * m)[:, None] * base.turn_D)
    by_x, none = into * (turned - 1.0), np.zeros_like(L)
    own = np.column_stack((by_x, 1j * by_x, -1j * L, by_base[:, -1], none, -L / scale))
    return L, np.column_stack((by_base[:, :-1], own))


def lidar_poses(drive: CalibrationDrive, parameters: Array, times: Array) -> Array:
    """Return the lidar's poses (k, 3) by odometry at times (k,), s, in its frame at the first one."""
    p = len(drive.model.names)
    x, y, yaw, latency, _, scale = parameters[p:]
    first = np.full_like(times, times[0])
    base = motion(drive.model, parameters[:p], latency, first, times)
    L, _ = _seen(base, complex(x, y), yaw, scale)
    return np.column_stack((L.real, L.imag, base.turn))
