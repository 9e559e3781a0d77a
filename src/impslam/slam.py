"""SLAM on arrays, for programs with their own scans and odometry: one row at a time, or many."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.checked_arrays import finite, numeric, rows_of
from impslam.columns import Columns
from impslam.config import Config
from impslam.continuing import begin_with
from impslam.errors import ConfigError, ImpError
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome, checked_observers
from impslam.odometry.synchroniser import MAX_WAIT
from impslam.open_log import finished, for_continuing
from impslam.run import Run
from impslam.sources.text import TURNS_LIMIT
from impslam.tracking.screening import SILENT
from impslam.types import (
    Array,
    LaserScan,
    OdometryPose,
    Stamped,
    Velocity,
    WheelAngles,
    check_shape,
)


class Slam:
    """Maps scans and odometry that are given as arrays.

    Rows are processed in the order of the calls. Add them in order of time, but odometry ahead of the
    scans: a scan waits for odometry that covers its sweep, for the next 25 rows of any stream at most, and
    is then used with the odometry received so far. Odometry may be added whole or in pieces. Interleave the
    scans of several lidars. The map is the same to the bit for any number of rows per call.

    Parameters
    ----------
    config : a preset's name, a file, or a config
    settings : overrides of the config, each as "key=value"
    observers : additional observers of the run; `finish` passes them the map
    progress : called with the number of scans used so far, after each call that used some
    known : a map to continue, or its file; the start of the robot is located in it
    frozen : localise in that map without changing it
    hint : (2,) or (3,) m, m, rad, approximate pose of the robot in the map at the start

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
        *,
        known: Map | str | Path | None = None,
        frozen: bool = False,
        hint: Sequence[float] | None = None,
    ) -> None:
        chosen = finished(config, settings)
        begin = begin_with(known, frozen=frozen, hint=hint)
        self._newest = _Newest(placed=begin is None)
        if begin is not None:
            chosen = for_continuing(chosen, settings)
        self._run = Run(chosen, [self._newest, *checked_observers(observers)], begin)
        self._run.robot.wait_for_rows_only()
        self._progress, self._order = progress, 0
        self._newest_stamps: dict[str, float] = {}  # by stream
        self._newest_scans: dict[str, float] = {}  # stamps by stream, of scans alone

    def add_odometry(self, stamps: npt.ArrayLike, poses: npt.ArrayLike) -> None:
        """Add poses `T_odom_base` (m, 3) or (3,), m and rad, at stamps (m,) or a number, s."""
        self._add(OdometryPose, stamps, {"pose": ("poses", poses, (3,))})

    def add_wheels(self, stamps: npt.ArrayLike, left: npt.ArrayLike, right: npt.ArrayLike) -> None:
        """Add wheel encoder readings (m,) in the unit of the config, at stamps (m,), s."""
        self._add(WheelAngles, stamps, {"left": ("left", left, ()), "right": ("right", right, ())})

    def add_velocities(
        self, stamps: npt.ArrayLike, speeds: npt.ArrayLike, turn_rates: npt.ArrayLike
    ) -> None:
        """Add speeds (m,) m/s and turn rates (m,) rad/s, each valid from its stamp (m,) s on."""
        fields = {"speed": ("speeds", speeds, ()), "turn_rate": ("turn_rates", turn_rates, ())}
        self._add(Velocity, stamps, fields)

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
        """Add sweeps of a 2D lidar.

        Parameters
        ----------
        stamps : (m,) or a number, s, of the first beam
        ranges : (m, n) or (n,) m; 0, NaN, masked values and those beyond the limits mean no echo
        angles : (n,) rad in the laser frame, counter-clockwise, 0 ahead
        time_offsets : (n,) s after the stamp at which each beam was fired; all at once by default
        range_min, range_max : m, the lidar's limits; NaN, or a range_max of 0: those of the config
        stream : the lidar's stream, if the config has several

        Raises
        ------
        ShapeError
            If the shapes do not match, or a value is not a number.
        ConfigError
            If no sensor of the config reads scans of this stream, no range is within the limits, or the
            angles are in degrees.
        """
        beams = finite("angles", angles, None)
        n = len(beams)
        if n and (turns := np.ptp(beams) / math.tau) > TURNS_LIMIT:
            raise ConfigError(
                f"angles: they span {turns:.0f} turns; give them in rad, not in degrees"
            )
        times = np.zeros(n) if time_offsets is None else finite("time_offsets", time_offsets, n)
        layout: dict[str, Any] = {"angles": beams, "time_offsets": times, "intensities": None}
        for name, limit in (("range_min", range_min), ("range_max", range_max)):
            array = numeric(name, limit)
            check_shape(name, array)
            layout[name] = float(array)
        if range_min < 0.0 or range_max < 0.0 or 0.0 < range_max <= range_min:
            raise ConfigError(
                f"range_min = {range_min:g}, range_max = {range_max:g}: no range is between them; "
                "give the lidar's limits in m, or leave them out"
            )
        self._add(LaserScan, stamps, {"ranges": ("ranges", ranges, (n,))}, layout, stream)

    def _add(
        self,
        kind: type[Stamped],
        stamps: npt.ArrayLike,
        fields: Mapping[str, _Field],
        layout: dict[str, Any] | None = None,
        stream: str = "",
    ) -> None:
        times = np.atleast_1d(numeric("stamps", stamps))
        times = finite("stamps", times, None)
        values = {"stamp": times}
        for field, (name, given, row) in fields.items():
            values[field] = rows_of(name, given, len(times), row)
        name = stream or kind.__name__
        self._run.robot.streams.check_reads(kind, name)
        if len(times) == 0:
            return
        self._refuse_late(name, times, is_scan=kind is LaserScan)
        order = self._order + np.arange(len(times))
        self._order += len(times)
        before = self._run.scans
        self._run.feed({name: Columns(name, kind, order, values, layout or {})})
        self._report_progress(before)

    def _refuse_late(self, name: str, times: Array, *, is_scan: bool) -> None:
        """Raise if several rows come too late to be used: they precede data already processed.

        A single row may be late, as on a robot. Rows older than the previous ones of their stream were
        stamped by a clock that was set back, and are accepted.
        """
        if len(times) > 1 and times[0] >= self._newest_stamps.get(name, -np.inf):
            used = self._newest.path
            others = [t for stream, t in self._newest_scans.items() if stream != name]
            upto = others if is_scan else [] if used is None else [float(used.stamps[-1])]
            if times[0] < max(upto, default=-np.inf):
                raise ImpError(
                    f"{name}: {len(times)} rows from {times[0]:.3f} s on come after the scan at "
                    f"{max(upto):.3f} s; add rows in order of time, several streams in turns: "
                    f"a scan waits for odometry for the next {MAX_WAIT} rows only"
                )
        self._newest_stamps[name] = float(times[-1])
        if is_scan:
            self._newest_scans[name] = float(times[-1])

    def _report_progress(self, before: int) -> None:
        if self._progress is not None and self._run.scans > before:
            self._progress(self._run.scans)

    @property
    def pose(self) -> Array:
        """`T_map_base` (3,), m and rad, at the newest scan used; before it, the config's start."""
        path = self._newest.path
        return np.array(self._run.config.start) if path is None else path.poses[-1].copy()

    @property
    def placed(self) -> bool:
        """Whether `pose` is located in the map; if not, it is in a frame of its own."""
        return self._newest.placed

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of `pose`; in a frozen map, relative to the map."""
        path = self._newest.path
        return np.zeros((3, 3)) if path is None else path.covariances[-1].copy()

    @property
    def odometry(self) -> Array:
        """`T_odom_base` (3,) m and rad at that scan, by dead reckoning from the start; it never jumps."""
        return self._run.odometry

    @property
    def T_map_odom(self) -> Array:
        """(3,) m and rad: pose of the frame of `odometry` in map; jumps when a loop closes (REP 105).

        `pose` is `compose(T_map_odom, odometry)`. A controller that must not jump works in odom; see
        `Run.T_map_odom`.
        """
        return self._run.T_map_odom

    @property
    def problems(self) -> dict[str, int]:
        """Number of rows that could not be used, or of other events that make the map worse, by reason.

        "odometry missing" counts the times that odometry was missing for more than a second; if none was
        added at all, the scans that were used without it.
        """
        counts = {kind: problem.count for kind, problem in self._run.dropped().items()}
        if self._run.scans and not self._run.has_odometry:
            counts[SILENT] = self._run.scans
        return counts

    def map(self) -> Map:
        """Return the map as it is now; more may be added."""
        known = self._run.map()
        return self._run.with_origin(known, self._outcome(known))

    def finish(self) -> Map:
        """Process the scans that still wait for odometry, and return the jointly refined map."""
        before = self._run.scans
        self._run.flush()
        self._report_progress(before)
        known = self._run.refined()
        outcome = self._outcome(known)
        known = self._run.with_origin(known, outcome)
        self._run.finish_observers(known, outcome)
        return known

    def _outcome(self, known: Map) -> Outcome:
        return self._run.outcome(Path(), "", len(known.landmarks))


class _Newest(Observer):
    """Remembers the newest pose."""

    def __init__(self, *, placed: bool) -> None:
        self.path: PathRows | None = None
        self.placed = placed

    def follow(self, track: Track, path: PathRows) -> None:
        del track
        self.path = path

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        del keyframe
        self.path, self.placed = path, revision.is_placed


_Field: TypeAlias = tuple[str, npt.ArrayLike, tuple[int, ...]]
"""The argument's name, its value, and the shape of one row."""
