"""Plot of a calibration: dead reckoning before and after, and the residuals of all motions.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from impslam.calibration.calibrate import Calibration
from impslam.calibration.residuals import CalibrationDrive, lidar_poses, residuals
from impslam.evaluation.colours import INK, ODOMETRY, PALE, PATH
from impslam.evaluation.plots import TIGHT, as_png, new_figure, quiet, style
from impslam.types import Array

STYLES = (("by the config", ODOMETRY, 3.0), ("calibrated", PATH, 5.0))


def calibration_png(calibration: Calibration, title: str) -> bytes:
    """Draw the first drive's path, and the residuals of all drives."""
    figure = new_figure(9.0, 6.4, dpi=150)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.15, 1.0))[0]
    figure.suptitle(title, color=INK, fontsize=10)
    _draw_path(left.subplots(), calibration.drives[0], calibration)
    panels = right.subplots(2, 1, sharex=True)
    for axes, part, what in zip(panels, (0, 2), ("distance in mm", "turn in mrad"), strict=True):
        _draw_residuals(axes, calibration, part, what)
    panels[1].set_xlabel("motion of the lidar, in the order of the logs")
    return as_png(figure, **TIGHT)


def _draw_path(axes: Axes, drive: CalibrationDrive, calibration: Calibration) -> None:
    """Draw the lidar's path by its scans, and by odometry with both sets of parameters."""
    path, model = drive.path, drive.model
    if path is not None:
        latency = calibration.solution.parameters[len(model.names) + 3]
        first, last = model.stamps[0] + latency, model.stamps[-1] + latency
        inside = (path.middles >= first) & (path.middles <= last)
        times, by_scans = path.middles[inside], path.poses[inside]
        axes.plot(*_from_start(by_scans).T, color=PALE, lw=2.2, label="by the scans alone")
        for (name, colour, _), values in zip(STYLES, _both(calibration), strict=True):
            poses = lidar_poses(drive, values, times)
            axes.plot(poses[:, 0], poses[:, 1], color=colour, lw=1.0, label=f"odometry, {name}")
    axes.set_title("Path of the lidar", color=INK, fontsize=10)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8, frameon=False)
    style(axes)


def _from_start(poses: Array) -> Array:
    """Return the positions (n, 2) of poses (n, 3) in the frame of the first one."""
    offset = poses[:, 0] + 1j * poses[:, 1] - complex(*poses[0, :2])
    position = offset * np.exp(-1j * poses[0, 2])
    return np.column_stack((position.real, position.imag))


def _both(calibration: Calibration) -> tuple[Array, Array]:
    return calibration.start, calibration.solution.parameters


def _draw_residuals(axes: Axes, calibration: Calibration, part: int, what: str) -> None:
    for (name, colour, size), values in zip(STYLES, _both(calibration), strict=True):
        off = np.concatenate(
            [residuals(drive, values).values[:, part] for drive in calibration.drives]
        )
        rms = 1000.0 * float(np.sqrt(np.mean(off**2)))
        axes.plot(
            1000.0 * off, ".", color=colour, ms=size, alpha=0.7, label=f"{name}: rms {rms:.1f}"
        )
    axes.set_ylabel(f"odometry minus scans, {what}")
    above = (1.0, 1.0)
    axes.legend(fontsize=8, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=above)
    quiet(axes)
