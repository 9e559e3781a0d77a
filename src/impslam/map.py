"""The map as a value: keyframes, the path relative to them, and landmarks.

The pose of each sweep is stored relative to the previous keyframe, `T_map_base = T_map_keyframe *
T_keyframe_base`. When an estimator moves keyframes, the path moves with them, and no stored pose changes
(kiss-slam stores its trajectory in the same way, Guadagnino et al. 2025).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from impslam.checked_arrays import finite
from impslam.columns import Sweeps
from impslam.component import shorten
from impslam.errors import ConfigError, ImpError
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel, read_only
from impslam.geometry.se2 import compose, inverse
from impslam.health import NONE, Reasons
from impslam.maps import archive, layout
from impslam.maps.direction import Direction, main_direction
from impslam.maps.grid import OccupancyGrid, PlacedScans
from impslam.maps.moving import moved_covariances, moved_joint, moved_landmark
from impslam.types import (
    NO_COVARIANCE,
    NO_EDGES,
    Array,
    Edges,
    Increment,
    Innovation,
    Ints,
    Landmark,
    Mask,
    Match,
    Observation,
    Scan,
)

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Row and column indices of the distinct entries of a symmetric (3, 3) matrix, as in trajectory.csv."""
SYMMETRIC = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Indices of the nine entries of a symmetric (3, 3) matrix in its six distinct ones."""


class PathRows(NamedTuple):
    """Poses at the stamps of m sweeps.

    Attributes
    ----------
    stamps : (m,) s, as in the log
    poses : (m, 3) `T_map_base`
    covariances : (m, 3, 3)
    odometry : (m, 3) dead reckoning from the same start
    """

    stamps: Array
    poses: Array
    covariances: Array
    odometry: Array


REACH_SIGMAS = 3.0
"""Standard deviations of position and heading in the `reach` of a keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A sweep for the estimator: the motion since the previous keyframe, and the observations.

    Attributes
    ----------
    id : 0, 1, ... in the order of the run
    stamp : s, of the sweep in the log
    motion : from the previous keyframe (or the start of the run) to the middle of the sweep, with its
        stamp on the common time line, which stays continuous when clocks are set
    odometry : (3,) `T_odom_base` at `stamp`, dead reckoning from the start of the run
    T_keyframe_stamp, stamp_covariance : (3,), (3, 3) motion from the sweep's middle to `stamp`
    sweeps, row : the sweep is this row of its sensor's data
    scan : the sweep in base_link at its middle, None for a sensor that has none
    observations : landmarks that the extractors found in the scan
    located : whether the tracker's match of the scan determines the position along both axes
    lost : whether the motion from the previous keyframe is unknown: the keyframe begins a session,
        which is not part of the map until it is located in it. `motion` is a guess, or NaN
    reason, amount : why the pose cannot be trusted, and the related distance or share; see
        `impslam.health`
    reach : m, rad around the pose in which the robot may be after a gap in the data that odometry does not
        cover: `REACH_SIGMAS` standard deviations; zeros otherwise
    """

    id: int
    stamp: float
    motion: Increment
    odometry: Array
    T_keyframe_stamp: Array
    stamp_covariance: Array
    sweeps: Sweeps
    row: int
    scan: Scan | None = None
    observations: tuple[Observation, ...] = ()
    located: bool = False
    lost: bool = False
    reason: int = NONE
    amount: float = 0.0
    reach: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The motion since a keyframe: m sweeps relative to it, and the next keyframe.

    Attributes
    ----------
    anchor : id of the keyframe; -1 before the first one, with m = 0
    stamps : (m,) s, as in the log
    T_anchor_base : (m, 3) at these stamps
    covariance : (m, 3, 3) of that motion
    odometry : (m, 3) `T_odom_base` at these stamps
    sweeps, rows : the m sweeps are these rows of their sensor's data
    located : (m,) whether the tracker's match of each determines the position along both axes
    reasons, amounts : (m,) why each pose cannot be trusted, and the related distance or share
    keyframe : the keyframe that ends the track, None if the track continues
    """

    anchor: int
    stamps: Array
    T_anchor_base: Array
    covariance: Array
    odometry: Array
    sweeps: Sweeps
    rows: slice
    located: Mask
    reasons: Reasons
    amounts: Array
    keyframe: Keyframe | None


@dataclass(frozen=True, slots=True, eq=False)
class Revision:
    """Changes of the map that a keyframe causes.

    Attributes
    ----------
    ids : (r,) keyframes whose pose is new, ascending: earlier ones that were moved; the last one is
        the keyframe itself
    poses : (r, 3) `T_map_base` at the middle of their sweeps
    covariances : (r, 3, 3)
    matches : observations that were matched to known landmarks
    ambiguous : observations (indices) left unmatched because their landmark is not certain
    added, origins : ids of new landmarks, and the observation from which each was created
    removed : ids of removed landmarks
    refused : why the keyframe could not be used, "" if it was used
    placed : (r,) or one for all, whether they are located in the map
    assumed : whether the newest pose is based on odometry alone since the robot got lost
    contradicted : whether what was seen earlier contradicts the newest scans at their poses
    fits_elsewhere : whether the newest scans also fit other places within the uncertainty
    dropped : keyframes whose scans are removed because they add nothing to those of others
    begins : keyframes at which the estimator begins a session, although their motion is known; they may be
        repeated
    innovation : of all matches jointly, None if unknown
    """

    ids: Ints
    poses: Array
    covariances: Array
    matches: tuple[Match, ...] = ()
    ambiguous: tuple[int, ...] = ()
    added: tuple[int, ...] = ()
    origins: tuple[int, ...] = ()
    removed: tuple[int, ...] = ()
    refused: str = ""
    placed: Mask | bool = True
    assumed: bool = False
    contradicted: bool = False
    fits_elsewhere: bool = False
    dropped: tuple[int, ...] = ()
    begins: tuple[int, ...] = ()
    innovation: Innovation | None = None

    @property
    def is_placed(self) -> bool:
        """Whether the newest keyframe is located in the map."""
        placed = self.placed
        return bool(placed[-1] if isinstance(placed, np.ndarray) else placed)

    def nis(self) -> tuple[float, int]:
        """Return the normalised innovation squared of the matches and its degrees of freedom.

        If the joint innovation is unknown, they are the sums over the matches, with the same mean.
        """
        if self.innovation is not None:
            return self.innovation.nis, self.innovation.dof
        return (
            sum(match.distance2 for match in self.matches),
            sum(len(match.innovation) for match in self.matches),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """The keyframes of a map as columns.

    Attributes
    ----------
    stamps : (k,) s
    poses, covariances : (k, 3) `T_map_base` at the middle of the sweep, and (k, 3, 3)
    innovations : (k, 3) number of matches, normalised innovation squared, its degrees of freedom
    origins : (k, 2) m, position of the laser in base_link
    starts : (k + 1,) the points of keyframe i are `points[starts[i] : starts[i + 1]]`
    points : (p, 2) float32 m, end points of valid beams, in base_link at the middle of the sweep
    motions, motion_covariances : (k, 3), (k, 3, 3) as tracked, from the previous keyframe, or from the
        start; for the first keyframe of a session a guess, or NaN
    sessions : (k,) number of the session, 0, 1, ...; motions connect the keyframes of a session, see
        `with_begins`
    placed : (k,) whether the keyframe is located in the map; if not, its pose is in the frame of its
        session, and it is not part of the map
    """

    stamps: Array
    poses: Array
    covariances: Array
    innovations: Array
    origins: Array
    starts: Ints
    points: np.ndarray[Any, np.dtype[np.float32]]
    motions: Array
    motion_covariances: Array
    sessions: Ints
    placed: Mask

    def __len__(self) -> int:
        return len(self.stamps)

    def take(self, rows: Ints) -> Keyframes:
        """Return some of the keyframes (r,), in the order of the rows."""
        lengths = np.diff(self.starts)[rows]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        points = np.repeat(self.starts[rows] - starts[:-1], lengths) + np.arange(starts[-1])
        some = {f.name: getattr(self, f.name) for f in fields(self)}
        some = {
            name: column[rows] for name, column in some.items() if name not in ("starts", "points")
        }
        return Keyframes(**{**some, "starts": starts, "points": self.points[points]})

    def draw(self, grid: OccupancyGrid) -> None:
        """Draw the scans into a grid, which may already contain the first of them.

        Keyframes that are not placed are omitted.
        """
        poses, starts, points = self.poses, self.starts, self.points
        if not self.placed.all():
            poses = np.where(
                self.placed[:, None], poses, np.nan
            )  # one that is placed later has moved
            points = points[np.repeat(self.placed, np.diff(starts))]
            lengths = np.where(self.placed, np.diff(starts), 0)
            starts = np.concatenate([[0], np.cumsum(lengths)])
        grid.draw(PlacedScans(poses, self.origins, starts, points))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Map:
    """The result of a run.

    Attributes
    ----------
    keyframes : poses and scans of the keyframes
    landmarks : walls, cylinders, ... with their covariances
    stamps : (n,) s of all sweeps, in processing order
    anchors : (n,) row of the keyframe that each sweep is relative to
    T_anchor_base : (n, 3) pose of base_link at the stamp, relative to that keyframe
    track_covariances : (n, 6) distinct entries of that motion's covariance, in the order of `UPPER`
    odometry_poses : (n, 3) dead reckoning
    live_poses : (n, 3) `T_map_base` of each sweep as estimated at its time
    tracked : (n, 3) `T_anchor_base` as tracked, before it is blended with the next keyframe
    edges : the pose graph: motions and loop closures between keyframes i and j; may be empty
    observations : of landmarks, by keyframe, if the estimator needs them to continue the map
    landmark_covariance : (2 k, 2 k) joint covariance of the k landmarks, in their order; (0, 0) if the
        estimator has none
    about : origin of the map: log, config, counts, versions, as JSON values

    Examples
    --------
    >>> import tempfile
    >>> import impslam
    >>> slam = impslam.Slam("default")
    >>> slam.add_odometry([0.0, 1.0], [[0.0, 0.0, 0.0], [0.5, 0.0, 0.1]])
    >>> slam.add_scans([0.0, 1.0], [[2.0, 2.1, 2.2]] * 2, [-0.1, 0.0, 0.1])
    >>> known = slam.finish()
    >>> known.path().round(3).tolist()
    [[0.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.1]]
    >>> file = known.save(f"{tempfile.mkdtemp()}/office.imp")
    >>> impslam.Map.load(file)
    <Map: 2 scans, 2 keyframes, 0 landmarks>
    """

    keyframes: Keyframes
    landmarks: tuple[Landmark, ...]
    stamps: Array
    anchors: Ints
    T_anchor_base: Array
    track_covariances: Array
    odometry_poses: Array
    live_poses: Array
    tracked: Array
    edges: Edges = NO_EDGES
    observations: tuple[tuple[Observation, ...], ...] = ()
    landmark_covariance: Array = field(default_factory=lambda: NO_COVARIANCE)
    about: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return the sizes of the map instead of its arrays."""
        counts = (len(self.stamps), len(self.keyframes), len(self.landmarks))
        return "<Map: {} scans, {} keyframes, {} landmarks>".format(*counts)

    def revised(self, revision: Revision) -> Map:
        """Return the map with the poses and sessions of a revision."""
        names = ("poses", "covariances", "placed")
        columns = {name: getattr(self.keyframes, name).copy() for name in names}
        for name in names:
            columns[name][revision.ids] = getattr(revision, name)
        columns["sessions"] = with_begins(self.keyframes.sessions, revision.begins)
        return replace(self, keyframes=replace(self.keyframes, **columns))

    def rows(self) -> PathRows:
        """Return the current estimate of the path with covariances."""
        keyframes, at = self.keyframes, self.placed()
        parts = self.anchors[at], self.T_anchor_base[at], self.track_covariances[at]
        poses, covariances = poses_in_map(
            *read_only(keyframes.poses, keyframes.covariances, *parts)
        )
        return PathRows(self.stamps[at], poses, covariances, self.odometry_poses[at])

    def placed(self) -> Mask:
        """Return which sweeps (n,) are located in the map."""
        return np.asarray(self.keyframes.placed[self.anchors])

    def path(self) -> Array:
        """Return (n, 4) stamp, x, y, theta of base_link in map, a row for each sweep.

        Sweeps of sessions that are not placed in the map are omitted, here and in the paths below.
        """
        rows = self.rows()
        return np.column_stack((rows.stamps, rows.poses))

    def live_path(self) -> Array:
        """Return (n, 4) stamp, x, y, theta as estimated at the time of each sweep."""
        return np.column_stack((self.stamps, self.live_poses))[self.placed()]

    def odometry(self) -> Array:
        """Return (n, 4) stamp, x, y, theta by dead reckoning from the same start."""
        return np.column_stack((self.stamps, self.odometry_poses))[self.placed()]

    def grid(self, resolution: float = 0.05) -> OccupancyGrid:
        """Draw the occupancy grid from the keyframes' scans; `resolution` is a cell's side in m.

        Raises
        ------
        ConfigError
            If the resolution is out of range.
        """
        grid = OccupancyGrid(resolution)
        self.keyframes.draw(grid)
        return grid

    def moved(self, T: npt.ArrayLike) -> Map:
        """Return the map after a rigid motion T (3,), which moves a point p to T p.

        Tracks, edges and scans are relative and do not change.

        Raises
        ------
        ShapeError
            If T is not three finite numbers.
        """
        T = finite("T", T, 3)
        at = self.keyframes
        keyframes = replace(
            at, poses=compose(T, at.poses), covariances=moved_covariances(T, at.covariances)
        )
        return replace(
            self,
            keyframes=keyframes,
            landmarks=tuple(moved_landmark(T, landmark) for landmark in self.landmarks),
            landmark_covariance=moved_joint(T, self.landmarks, self.landmark_covariance),
            odometry_poses=compose(T, self.odometry_poses),
            live_poses=compose(T, self.live_poses),
        )

    def direction(self) -> Direction:
        """Return the main direction of the walls, and how dominant it is."""
        rows = self.keyframes.take(np.flatnonzero(self.keyframes.placed))
        return main_direction(rows.poses, rows.starts, rows.points)

    def straightened(self) -> Map:
        """Return the map rotated about its origin, by at most 45 degrees, to align its walls with the axes.

        Raises
        ------
        ImpError
            If the walls have no main direction.

        Examples
        --------
        >>> import numpy as np
        >>> import impslam
        >>> bearings = np.radians(np.arange(-180, 180))
        >>> ahead = bearings - 0.3  # a square room, seen by a robot that is turned in it
        >>> ranges = 2.0 / np.maximum(abs(np.cos(ahead)), abs(np.sin(ahead)))
        >>> slam = impslam.Slam("default")
        >>> slam.add_odometry(0.0, [0.0, 0.0, 0.0])
        >>> slam.add_scans(0.0, ranges, bearings)
        >>> known = slam.finish()
        >>> round(known.direction().angle, 3), round(known.straightened().direction().angle, 3)
        (0.3, 0.0)
        """
        direction = self.direction()
        if not direction.is_clear:
            raise ImpError(
                f"the walls have no main direction: {100 * direction.share:.0f} % of their length "
                f"is within 5 degrees of one direction, {100 * direction.rival:.0f} % of another; "
                "straighten maps of rectangular buildings"
            )
        return self.moved(np.array([0.0, 0.0, -direction.angle]))

    def save(self, path: str | Path) -> Path:
        """Write the map to one file, completely or not at all, and return its path.

        Raises
        ------
        ConfigError
            If the path is a file that is not a map.
        ImpError
            If the file cannot be written.
        """
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        keyframes = {f.name: getattr(self.keyframes, f.name) for f in fields(self.keyframes)}
        rest = (self.landmarks, self.edges, self.observations)
        return archive.save(Path(path), layout.to_arrays(columns, keyframes, *rest), self.about)

    @staticmethod
    def load(path: str | Path) -> Map:
        """Read a map that `save` wrote.

        Raises
        ------
        ImpError
            If the file is missing, damaged, not a map, or of a newer version.
        """
        if not isinstance(path, str | Path):
            raise ImpError(f"path = {shorten(path)}: expected the path of a map's file")
        return archive.load(Path(path), layout.layout, _built)


def check_map(name: str, value: object) -> None:
    """Raise `ConfigError` with the argument's name unless a value is a `Map`."""
    if not isinstance(value, Map):
        raise ConfigError(
            f"{name} = {shorten(value)}: expected a Map; Map.load reads one from a file"
        )


def _built(arrays: archive.Arrays, about: dict[str, Any]) -> Map:
    parts = layout.from_arrays(arrays)
    return Map(**{**parts, "keyframes": Keyframes(**parts["keyframes"]), "about": about})


def session_starts(sessions: Ints) -> Mask:
    """Return whether each keyframe (k,) is the first one of its session, given their numbers (k,)."""
    return np.append(True, sessions[1:] != sessions[:-1])[: len(sessions)]


def with_begins(sessions: Ints, begins: Sequence[int]) -> Ints:
    """Return the session numbers (k,) of keyframes after sessions begin at some of them, too."""
    is_first = session_starts(sessions)
    is_first[list(begins)] = True
    return np.cumsum(is_first) - 1


@kernel
def poses_in_map(
    keyframes: Array,
    keyframe_covariances: Array,
    anchors: Ints,
    T_anchor_base: Array,
    covariances: Array,
) -> tuple[Array, Array]:
    """Return `T_map_base` (m, 3) and its covariance (m, 3, 3) to first order.

    keyframes (k, 3) with keyframe_covariances (k, 3, 3) are `T_map_keyframe`, and anchors (m,) their rows;
    covariances (m, 6) are of `T_anchor_base`, in the order of `UPPER`. The errors of both parts are
    independent and additive.
    """
    poses = np.empty((len(anchors), 3))
    out = np.empty((len(anchors), 3, 3))
    motion = np.empty((3, 3))
    for k in range(len(anchors)):
        poses[k], out[k] = keyframes[anchors[k]], keyframe_covariances[anchors[k]]
        for i in range(9):
            motion[i // 3, i % 3] = covariances[k, SYMMETRIC[i]]
        advance(poses[k], out[k], T_anchor_base[k], motion)
    return poses, out


def T_map_odom(pose: Array, odometry: Array) -> Array:
    """Return `T_map_odom` (3,) from `T_map_base` and `T_odom_base` (3,) at one stamp (REP 105)."""
    return compose(pose, inverse(odometry))
