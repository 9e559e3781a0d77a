"""Simulates the sweeps of a lidar on a moving robot in a world with moving objects."""

from __future__ import annotations

import numpy as np

from impslam.geometry.angles import wrap
from impslam.simulation.drive import Path
from impslam.simulation.raycast import trace
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.types import Array, Ints

_PARTS = np.linspace(-0.4, 0.4, 5)  # centres of five equal parts of a beam's width


class LidarSimulator:
    """The sweeps of a lidar along a path; holds the run's bias and the noise stream."""

    def __init__(
        self, lidar: Lidar, scene: Scene, trajectory: Path, rng: np.random.Generator
    ) -> None:
        self._lidar, self._scene, self._trajectory, self._rng = lidar, scene, trajectory, rng
        self._bias = lidar.bias_sigma * float(rng.standard_normal())
        beams = np.arange(lidar.beams, dtype=np.float64)
        self.angles: Array = lidar.angle_min + lidar.angle_step * beams
        self.time_offsets: Array = lidar.beam_time * beams

    @property
    def duration(self) -> float:
        """Time from the first to the last beam, in s."""
        return float(self.time_offsets[-1])

    @property
    def limits(self) -> tuple[float, float]:
        """Minimum and maximum range, m."""
        return self._lidar.range_min, self._lidar.range_max

    def ranges(self, time: float) -> Array:
        """Return the measured ranges (n,) of the sweep that begins at a time, m."""
        exact, cosines = self._cast(time)
        return self._add_faults(exact, cosines)

    def _cast(self, time: float) -> tuple[Array, Array]:
        lidar, scene = self._lidar, self._scene
        lasers = laser_poses(self._trajectory.at(time + self.time_offsets), lidar.mount)
        centre = 0.5 * (lasers[0, :2] + lasers[-1, :2])
        spread = float(np.hypot(*(lasers[:, :2] - centre).T).max())
        static = scene.near(centre, lidar.range_max + spread)
        moving = scene.moving(time, time + self.duration)
        fractions = self.time_offsets / max(self.duration, 1e-9)

        def cast(beams: Ints, angles: Array) -> tuple[Array, Array]:
            timed = lasers[beams], angles, fractions[beams]
            return trace(*timed, static, moving, lidar.range_max)[:2]

        ranges, cosines = cast(np.arange(lidar.beams, dtype=np.int64), self.angles)
        edges = _edges(ranges, lidar.edge) if lidar.divergence else np.empty(0, np.int64)
        if len(edges):
            parts = self.angles[edges, None] + lidar.divergence * _PARTS
            mixed, _ = cast(np.repeat(edges, len(_PARTS)), parts.ravel())
            ranges[edges] = _mix(mixed.reshape(parts.shape))
        return ranges, cosines

    def _add_faults(self, exact: Array, cosines: Array) -> Array:
        """Return ranges with noise, bias, resolution, losses and limits, given exact ranges."""
        lidar = self._lidar
        noise, draws = self._rng.standard_normal(len(exact)), self._rng.random(len(exact))
        seen = np.isfinite(exact) & (draws >= lidar.dropout)
        seen &= cosines >= np.cos(min(lidar.grazing, 0.5 * np.pi))
        read = np.where(seen, exact, 0.0)
        read = read + self._bias + (lidar.sigma + lidar.sigma_rate * read) * noise
        if lidar.resolution:
            read = np.round(read / lidar.resolution) * lidar.resolution
        seen &= (read >= lidar.range_min) & (read <= lidar.range_max)
        return np.where(seen, read, lidar.no_return)


def laser_poses(poses: Array, mount: tuple[float, float, float]) -> Array:
    """Return the poses (n, 3) of a laser mounted on a base at poses (n, 3)."""
    x, y, heading = poses.T
    c, s = np.cos(heading), np.sin(heading)
    dx, dy, turn = mount
    return np.column_stack([x + c * dx - s * dy, y + s * dx + c * dy, wrap(heading + turn)])


def _edges(ranges: Array, jump: float) -> Ints:
    """Return the indices of beams next to a range jump."""
    far = np.where(np.isfinite(ranges), ranges, 1e3)
    jumps = np.abs(np.diff(far)) > jump
    return np.flatnonzero(np.append(jumps, False) | np.insert(jumps, 0, False))


def _mix(parts: Array) -> Array:
    """Return the ranges of beams, given those of their parts (n, k).

    The URG-04LX compares phases: a beam that hits two surfaces measures a range between them, weighted by
    the shares of its light; parts without an echo do not count.
    """
    hit = np.isfinite(parts)
    number = hit.sum(1)
    total = np.where(hit, parts, 0.0).sum(1)
    return np.where(number > 0, total / np.maximum(number, 1), np.inf)
