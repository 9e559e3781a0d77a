"""Ground truth of a simulated sweep: the things hit by its beams, and the robot's true motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.geometry.se2 import between, log
from impslam.simulation.drive import Trajectory
from impslam.simulation.lidar import laser_poses
from impslam.simulation.raycast import trace
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.types import Array, Ints


@dataclass(frozen=True, slots=True, eq=False)
class TracedSweep:
    """A sweep without noise.

    Attributes
    ----------
    pose : (3,) `T_map_base` in the middle of the sweep
    lasers : (n, 3) `T_map_laser` as each beam is fired
    angles : (n,) rad, beams in the laser frame
    ranges : (n,) m; 0 if nothing is within range
    hits : (n,) index in `Scene.things` of the thing hit by each beam; -1 for none
    straight : (t, 4) m, start and end of straight things, else NaN
    round : (t, 3) m, centre and radius of round things, else NaN
    legs : (k, 3) m, the last ones of `round`: two for each person
    """

    pose: Array
    lasers: Array
    angles: Array
    ranges: Array
    hits: Ints
    straight: Array
    round: Array
    legs: Array


def trace_sweep(scene: Scene, lidar: Lidar, path: Trajectory, time: float) -> TracedSweep:
    """Trace the sweep that begins at a time; moving things are given at its middle."""
    offsets = lidar.beam_time * np.arange(lidar.beams, dtype=np.float64)
    angles = lidar.angle_min + lidar.angle_step * np.arange(lidar.beams, dtype=np.float64)
    duration = float(offsets[-1])
    lasers = laser_poses(path.at(time + offsets), lidar.mount)
    standing, moving = (scene.segments, scene.circles), scene.moving(time, time + duration)
    fractions = offsets / max(duration, 1e-9)
    ranges, _, hits = trace(lasers, angles, fractions, standing, moving, lidar.range_max)
    leaves, legs = (ends.mean(axis=0) for ends in moving)
    groups = (scene.segments, scene.circles, leaves, legs)
    straight, round_ = (
        np.vstack(
            [rows if rows.shape[1] == k else np.full((len(rows), k), np.nan) for rows in groups]
        )
        for k in (4, 3)
    )
    pose = path.at(np.array([time + 0.5 * duration]))[0]
    ranges = np.where(np.isfinite(ranges), ranges, 0.0)
    return TracedSweep(pose, lasers, angles, ranges, hits, straight, round_, legs)


def true_twist(path: Trajectory, begin: float, end: float) -> Array:
    """Return the mean velocity (3,) between two times, m/s and rad/s in the robot's frame."""
    first, last = path.at(np.array([begin, end]))
    return np.asarray(log(between(first, last)) / max(end - begin, 1e-9))
