"""SLAM on arrays: for a program that has scans and odometry of its own, a row at a time or many."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from impslam.columns import Columns
from impslam.config import Config, load
from impslam.errors import ConfigError, ShapeError
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer
from impslam.run import Run
from impslam.types import (
    Array,
    LaserScan,
    Message,
    OdometryPose,
    Stamped,
    Velocity,
    WheelAngles,
    check_shape,
)


class Slam:
    """Maps scans and odometry that are given as arrays.

    Rows are used in the order in which they are given. A scan waits until odometry covers its
    sweep, so give what happened first first; within that, one row at a time or all at once gives
    the same map to the bit.

    Parameters
    ----------
    config : a preset's name, a file, or a config
    settings : laid over it, each as "key=value"
    observers : what else is to see the run
    progress : called with the number of scans used so far, after each call that used some

    Examples
    --------
    A robot that turns on the spot in the middle of a square room of 4 m:

    >>> import numpy as np
    >>> import impslam
    >>> angles = np.radians(np.arange(-180, 180))
    >>> headings = np.arange(0, 60) * 0.02
    >>> facing = angles + headings[:, None]
    >>> ranges = 2.0 / np.maximum(abs(np.cos(facing)), abs(np.sin(facing)))
    >>> slam = impslam.Slam("default")
    >>> stamps = 0.1 * np.arange(60)
    >>> slam.add_odometry(stamps, np.column_stack([np.zeros((60, 2)), headings]))
    >>> slam.add_scans(stamps, ranges, angles, range_max=10.0)
    >>> known = slam.finish()
    >>> known.path().shape
    (60, 4)
    >>> sum(landmark.kind == "wall" for landmark in known.landmarks)
    4
    """

    def __init__(
        self,
        config: str | Path | Config = "default",
        settings: Sequence[str] = (),
        observers: Iterable[Observer] = (),
        progress: Callable[[int], None] | None = None,
    ) -> None:
        if isinstance(config, Config) and settings:
            raise ConfigError("settings go with a preset or a file, not with a finished config")
        chosen = config if isinstance(config, Config) else load(config, settings)
        self._newest = _Newest()
        self._run = Run(chosen, [self._newest, *observers])
        self._progress, self._order = progress, 0

    def add_odometry(self, stamps: npt.ArrayLike, poses: npt.ArrayLike) -> None:
        """Give poses `T_odom_base` (m, 3) or (3,), m and rad, at stamps (m,) or a number, s."""
        self._add(OdometryPose, stamps, {"pose": (poses, (3,))})

    def add_wheels(self, stamps: npt.ArrayLike, left: npt.ArrayLike, right: npt.ArrayLike) -> None:
        """Give readings (m,) of the wheels' encoders in the config's unit, at stamps (m,), s."""
        self._add(WheelAngles, stamps, {"left": (left, ()), "right": (right, ())})

    def add_velocities(
        self, stamps: npt.ArrayLike, speeds: npt.ArrayLike, turn_rates: npt.ArrayLike
    ) -> None:
        """Give speeds (m,) m/s and turn rates (m,) rad/s, which hold from their stamps (m,) s on."""
        self._add(Velocity, stamps, {"speed": (speeds, ()), "turn_rate": (turn_rates, ())})

    def add_scans(
        self,
        stamps: npt.ArrayLike,
        ranges: npt.ArrayLike,
        angles: npt.ArrayLike,
        *,
        time_offsets: npt.ArrayLike | None = None,
        range_min: float = float("nan"),
        range_max: float = float("nan"),
        stream: str = "",
    ) -> None:
        """Give sweeps of a 2D lidar.

        Parameters
        ----------
        stamps : (m,) or a number, s, of the first beam
        ranges : (m, n) or (n,) m; 0, NaN and what is beyond the limits is no echo
        angles : (n,) rad in the laser frame, counter-clockwise, 0 ahead
        time_offsets : (n,) s after the stamp at which each beam was fired; all at once by default
        range_min, range_max : m, the lidar's limits; NaN: none but the config's
        stream : the lidar's stream, where the config has several

        Raises
        ------
        ShapeError
            If the shapes do not fit each other, or something is no number.
        ConfigError
            If the config has no sensor for scans.
        """
        beams = _array("angles", angles)
        check_shape("angles", beams, None)
        n = len(beams)
        times = np.zeros(n) if time_offsets is None else _array("time_offsets", time_offsets)
        check_shape("time_offsets", times, n)
        layout: dict[str, Any] = {"angles": beams, "time_offsets": times, "intensities": None}
        layout |= {"range_min": float(range_min), "range_max": float(range_max)}
        self._add(LaserScan, stamps, {"ranges": (ranges, (n,))}, layout, stream)

    def _add(
        self,
        kind: type[Stamped],
        stamps: npt.ArrayLike,
        fields: dict[str, tuple[npt.ArrayLike, tuple[int, ...]]],
        layout: dict[str, Any] | None = None,
        stream: str = "",
    ) -> None:
        self._check_kind(kind)
        times = np.atleast_1d(_array("stamps", stamps))
        check_shape("stamps", times, None)
        values = {"stamp": times}
        for name, (given, row) in fields.items():
            array = _array(name, given)
            values[name] = array[None] if array.ndim == len(row) else array
            check_shape(name, values[name], len(times), *row)
        if len(times) == 0:
            return
        if not np.isfinite(times).all():
            raise ShapeError("stamps: not all are finite")
        order = self._order + np.arange(len(times))
        self._order += len(times)
        name = stream or kind.__name__
        before = self._run.scans
        self._run.feed({name: Columns(name, kind, order, values, layout or {})})
        self._report(before)

    def _check_kind(self, kind: type[Message]) -> None:
        robot = self._run.robot
        used = [robot.odometry.consumes, *(s.consumes for s in robot.sensors.values())]
        if kind not in used:
            known = ", ".join(sorted({one.__name__ for one in used}))
            raise ConfigError(
                f"this config has no use for {kind.__name__}, it takes {known}; choose another "
                "preset, or another odometry.kind"
            )

    def _report(self, before: int) -> None:
        if self._progress is not None and self._run.scans > before:
            self._progress(self._run.scans)

    @property
    def pose(self) -> Array:
        """`T_map_base` (3,) m and rad at the newest scan in use; the config's start before it."""
        path = self._newest.path
        return np.array(self._run.config.start) if path is None else path.poses[-1].copy()

    @property
    def covariance(self) -> Array:
        """(3, 3) of that pose."""
        path = self._newest.path
        return np.zeros((3, 3)) if path is None else path.covariances[-1].copy()

    @property
    def problems(self) -> dict[str, int]:
        """How many rows could not be used, by the reason."""
        return {**self._run.robot.problems.counts, **self._run.problems.counts}

    def map(self) -> Map:
        """Return the map as it is now; more may be added."""
        return self._run.map()

    def finish(self) -> Map:
        """Use the scans that still wait for odometry, and return the map."""
        before = self._run.scans
        self._run.flush()
        self._report(before)
        return self.map()


class _Newest(Observer):
    """Remembers the newest pose."""

    path: PathRows | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        del track
        self.path = path

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        del keyframe, revision
        self.path = path


def _array(name: str, values: npt.ArrayLike) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{name}: not an array of numbers ({error})") from None
