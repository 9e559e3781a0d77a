"""Plot of an overhead track on the camera picture, with its uncertainty (thesis Fig. 23)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from impslam.evaluation.colours import INK, PALE, PATH, POINT, TRUTH
from impslam.evaluation.plots import new_figure, quiet
from impslam.overhead.poses import corners_in_base, covariances_at
from impslam.overhead.setup import Setup
from impslam.overhead.track import Tracked
from impslam.types import Array

GRID = 33, 19  # points across and down at which the error is computed for its contours


def draw_track(tracked: Tracked, setup: Setup) -> Figure:
    """Return a figure of track, cylinders and error contours; below, the error over time."""
    figure = new_figure(9.0, 7.4)
    above, below = figure.subplots(2, 1, height_ratios=(3.2, 1.0))
    camera, height = tracked.calibration.camera, setup.marker.height
    above.imshow(tracked.still[..., ::-1], alpha=0.75)
    above.set_xlim(-0.5, camera.width - 0.5)
    above.set_ylim(camera.height - 0.5, -0.5)
    above.set_axis_off()
    _contours(above, tracked, setup)
    points = np.column_stack([tracked.found.poses[:, :2], np.full(len(tracked.stamps), height)])
    pixels = camera.project(points)
    gaps = np.flatnonzero(_gaps(tracked)) + 1
    for part in np.split(pixels, gaps):
        above.plot(*part.T, color=PATH, lw=1.6)
    above.plot(*pixels[[0, -1]].T, ".", color=PATH, ms=10)
    for cylinder in tracked.cylinders:
        assert setup.discs is not None
        pixel = camera.project(np.array([[*cylinder.centre, setup.discs.height]]))[0]
        above.plot(*pixel, "+", color=POINT, ms=14, mew=2)
    _draw_sigmas(below, tracked)
    return figure


def _gaps(tracked: Tracked) -> Any:
    """Return (n - 1,) whether there are pictures without a pose between consecutive poses."""
    missing = np.sort(np.concatenate([tracked.hidden, tracked.unfit]))
    before, after = tracked.stamps[:-1], tracked.stamps[1:]
    return np.searchsorted(missing, after) > np.searchsorted(missing, before)


def _contours(axes: Any, tracked: Tracked, setup: Setup) -> None:
    """Draw lines of equal standard deviation of a marker's position, in mm."""
    camera, marker = tracked.calibration.camera, setup.marker
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, GRID[0]), np.linspace(0, camera.height - 1, GRID[1])
    )
    points = camera.on_plane(np.column_stack([u.ravel(), v.ravel()]), marker.height)
    poses = np.column_stack([points, np.zeros(len(points))])
    corners = corners_in_base(marker.size, np.array(marker.mount))
    noise, shared = covariances_at(
        camera, poses, corners, marker.height, marker.height_sigma, tracked.found.sigma
    )
    sigma = 1e3 * _position_sigma(noise + shared).reshape(u.shape)
    lines = axes.contour(u, v, sigma, 6, colors=INK, linewidths=0.7, alpha=0.7)
    axes.clabel(lines, fmt="%g mm", fontsize=8)


def _position_sigma(covariances: Array) -> Array:
    """Return the standard deviations (n,) m of positions, the root of the sum of both variances."""
    return np.asarray(np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2)))


def _draw_sigmas(axes: Any, tracked: Tracked) -> None:
    """Draw standard deviations over time, and mark times without a pose."""
    times = tracked.stamps - tracked.stamps[0]
    sigma = 1e3 * _position_sigma(tracked.found.covariances)
    axes.plot(times, sigma, color=PATH, label="place, mm")
    heading = np.degrees(np.sqrt(tracked.found.covariances[:, 2, 2]))
    axes.plot(times, 10.0 * heading, color=TRUTH, label="heading, 0.1 deg")
    missing = np.concatenate([tracked.hidden, tracked.unfit]) - tracked.stamps[0]
    axes.vlines(missing, 0.0, axes.get_ylim()[1], color=PALE, lw=2, alpha=0.5, label="no pose")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time in s")
    axes.set_ylabel("standard deviation")
    axes.legend(ncols=3, fontsize=8, frameon=False)
    quiet(axes)
