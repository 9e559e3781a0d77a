"""The map as a value: keyframes, the path relative to them, and landmarks.

The pose of each sweep is stored relative to the previous keyframe, `T_map_base = T_map_keyframe *
T_keyframe_base`. When an estimator moves keyframes, the path moves with them, and no stored pose changes
(kiss-slam stores its trajectory in the same way, Guadagnino et al. 2025).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impslam.columns import Sweeps
from impslam.errors import ImpError
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import compose, inverse
from impslam.maps import archive
from impslam.maps.direction import Direction, main_direction
from impslam.maps.grid import OccupancyGrid, PlacedScans
from impslam.maps.moving import moved_covariances, moved_landmark
from impslam.types import (
    NO_EDGES,
    Array,
    Edges,
    Increment,
    Ints,
    Landmark,
    Mask,
    Match,
    Observation,
    Scan,
    check_shape,
)

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Row and column indices of the distinct entries of a symmetric (3, 3) matrix, as in trajectory.csv."""
SYMMETRIC = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Indices of the nine entries of a symmetric (3, 3) matrix in its six distinct ones."""


class PathRows(NamedTuple):
    """Poses at the stamps of m sweeps.

    Attributes
    ----------
    stamps : (m,) s, the log's own
    poses : (m, 3) `T_map_base`
    covariances : (m, 3, 3)
    odometry : (m, 3) dead reckoning from the same start
    """

    stamps: Array
    poses: Array
    covariances: Array
    odometry: Array


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A sweep for the estimator: the motion since the previous keyframe, and the observations.

    Attributes
    ----------
    id : 0, 1, ... in the order of the run
    stamp : s, of the sweep in the log
    motion : from the previous keyframe (or the start of the run) to the middle of the sweep, with its
        stamp on the common time line, which is continuous where clocks are set
    odometry : (3,) `T_odom_base` at `stamp`, dead reckoning from the start of the run
    T_keyframe_stamp, stamp_covariance : (3,), (3, 3) motion from the sweep's middle to `stamp`
    sweeps, row : the sweep is this row of its sensor's data
    contradicted : whether the scans contradict odometry; the motion is then that of the scans
    scan : the sweep in base_link at its middle, None for a sensor that has none
    observations : landmarks that the extractors found in the scan
    located : whether the tracker's match of the scan tells where the robot is, along both axes
    """

    id: int
    stamp: float
    motion: Increment
    odometry: Array
    T_keyframe_stamp: Array
    stamp_covariance: Array
    sweeps: Sweeps
    row: int
    contradicted: bool = False
    scan: Scan | None = None
    observations: tuple[Observation, ...] = ()
    located: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The motion since a keyframe: m sweeps relative to it, and the next keyframe.

    Attributes
    ----------
    anchor : id of the keyframe; -1 before the first one, with m = 0
    stamps : (m,) s, the log's own
    T_anchor_base : (m, 3) at these stamps
    covariance : (m, 3, 3) of that motion
    odometry : (m, 3) `T_odom_base` at these stamps
    sweeps, rows : the m sweeps are these rows of their sensor's data
    contradicted : (m,) whether the scans show another motion than odometry at each of them
    located : (m,) whether the tracker's match of each tells where the robot is, along both axes
    keyframe : the keyframe that ends the track, None if the track continues
    """

    anchor: int
    stamps: Array
    T_anchor_base: Array
    covariance: Array
    odometry: Array
    sweeps: Sweeps
    rows: slice
    contradicted: Mask
    located: Mask
    keyframe: Keyframe | None


@dataclass(frozen=True, slots=True, eq=False)
class Revision:
    """Changes of the map by a keyframe.

    Attributes
    ----------
    ids : (r,) keyframes whose pose is new: the keyframe itself, and earlier ones that were moved
    poses : (r, 3) `T_map_base` at the middle of their sweeps
    covariances : (r, 3, 3)
    matches : observations that were matched to known landmarks
    born, origins : ids of new landmarks, and the observation from which each was created
    gone : ids of removed landmarks
    refused : why the keyframe could not be used, "" if it was used
    """

    ids: Ints
    poses: Array
    covariances: Array
    matches: tuple[Match, ...] = ()
    born: tuple[int, ...] = ()
    origins: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()
    refused: str = ""


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
    """

    stamps: Array
    poses: Array
    covariances: Array
    innovations: Array
    origins: Array
    starts: Ints
    points: np.ndarray[Any, np.dtype[np.float32]]

    def __len__(self) -> int:
        return len(self.stamps)

    def draw(self, grid: OccupancyGrid) -> None:
        """Draw the scans into a grid, which may already contain the first of them."""
        grid.draw(PlacedScans(self.poses, self.origins, self.starts, self.points))


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
    live_poses : (n, 3) `T_map_base` of each sweep as it was estimated at the time
    edges : the pose graph: motions and loop closures between keyframes i and j; none without one
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
    edges: Edges = NO_EDGES
    about: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return the sizes of the map instead of its arrays."""
        counts = (len(self.stamps), len(self.keyframes), len(self.landmarks))
        return "<Map: {} scans, {} keyframes, {} landmarks>".format(*counts)

    def revised(self, revision: Revision) -> Map:
        """Return the map with the poses of a revision."""
        poses, covariances = self.keyframes.poses.copy(), self.keyframes.covariances.copy()
        poses[revision.ids], covariances[revision.ids] = revision.poses, revision.covariances
        keyframes = replace(self.keyframes, poses=poses, covariances=covariances)
        return replace(self, keyframes=keyframes)

    def rows(self) -> PathRows:
        """Return the current estimate of the path with covariances."""
        keyframes = self.keyframes
        poses, covariances = hang(
            keyframes.poses,
            keyframes.covariances,
            self.anchors,
            self.T_anchor_base,
            self.track_covariances,
        )
        return PathRows(self.stamps, poses, covariances, self.odometry_poses)

    def path(self) -> Array:
        """Return (n, 4) stamp, x, y, theta of base_link in map, a row for each sweep."""
        return np.column_stack((self.stamps, self.rows().poses))

    def live_path(self) -> Array:
        """Return (n, 4) stamp, x, y, theta as each was estimated at the time of its sweep."""
        return np.column_stack((self.stamps, self.live_poses))

    def odometry(self) -> Array:
        """Return (n, 4) stamp, x, y, theta by dead reckoning from the same start."""
        return np.column_stack((self.stamps, self.odometry_poses))

    def grid(self, resolution: float = 0.05) -> OccupancyGrid:
        """Draw the occupancy grid from the keyframes' scans; `resolution` is a cell's side in m.

        Raises
        ------
        ConfigError
            If no grid has such cells.
        """
        grid = OccupancyGrid(resolution)
        self.keyframes.draw(grid)
        return grid

    def moved(self, T: Array) -> Map:
        """Return the map after a rigid motion T (3,): what stood at p stands at T p.

        Tracks, edges and scans are relative, and stay as they are.
        """
        at = self.keyframes
        keyframes = replace(
            at, poses=compose(T, at.poses), covariances=moved_covariances(T, at.covariances)
        )
        return replace(
            self,
            keyframes=keyframes,
            landmarks=tuple(moved_landmark(T, landmark) for landmark in self.landmarks),
            odometry_poses=compose(T, self.odometry_poses),
            live_poses=compose(T, self.live_poses),
        )

    def direction(self) -> Direction:
        """Return the main direction of the walls, and how clear it is."""
        return main_direction(self.keyframes.poses, self.keyframes.starts, self.keyframes.points)

    def straightened(self) -> Map:
        """Return the map turned about its origin, by 45 degrees at most, with walls along the axes.

        Raises
        ------
        ImpError
            If the walls have no main direction.

        Examples
        --------
        >>> import numpy as np
        >>> import impslam
        >>> bearings = np.radians(np.arange(-180, 180))
        >>> ahead = bearings - 0.3  # a square room, seen by a robot that stands askew in it
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
                f"point one way and {100 * direction.rival:.0f} % another, within 5 degrees; "
                "straighten maps of rectangular buildings"
            )
        return self.moved(np.array([0.0, 0.0, -direction.angle]))

    def save(self, path: str | Path) -> Path:
        """Write the map to one file, completely or not at all, and return its path.

        Raises
        ------
        ImpError
            If the file cannot be written.
        """
        return archive.save(Path(path), _to_arrays(self), self.about)

    @staticmethod
    def load(path: str | Path) -> Map:
        """Read a map that `save` wrote.

        Raises
        ------
        ImpError
            If the file is missing, no map, damaged, or of a newer version.
        """
        return archive.load(Path(path), _layout, _from_arrays)


@kernel
def hang(
    keyframes: Array, spreads: Array, anchors: Ints, T_anchor_base: Array, covariances: Array
) -> tuple[Array, Array]:
    """Return `T_map_base` (m, 3) and its covariance (m, 3, 3) to first order.

    keyframes (k, 3) and spreads (k, 3, 3) are `T_map_keyframe`, of which anchors (m,) are the rows;
    covariances (m, 6) are of `T_anchor_base`, in the order of `UPPER`. The errors of both parts are
    independent and additive.
    """
    poses, out, motion = (
        np.empty((len(anchors), 3)),
        np.empty((len(anchors), 3, 3)),
        np.empty((3, 3)),
    )
    for k in range(len(anchors)):
        poses[k], out[k] = keyframes[anchors[k]], spreads[anchors[k]]
        for i in range(9):
            motion[i // 3, i % 3] = covariances[k, SYMMETRIC[i]]
        advance(poses[k], out[k], T_anchor_base[k], motion)
    return poses, out


def T_map_odom(pose: Array, odometry: Array) -> Array:
    """Return `T_map_odom` (3,) from `T_map_base` and `T_odom_base` (3,) at one stamp (REP 105)."""
    return compose(pose, inverse(odometry))


_LAYOUT: archive.Layout = {
    "stamps": ("f8", ("sweeps",)),
    "anchors": ("i8", ("sweeps",)),
    "T_anchor_base": ("f8", ("sweeps", 3)),
    "track_covariances": ("f8", ("sweeps", 6)),
    "odometry_poses": ("f8", ("sweeps", 3)),
    "live_poses": ("f8", ("sweeps", 3)),
    "keyframes/stamps": ("f8", ("keyframes",)),
    "keyframes/poses": ("f8", ("keyframes", 3)),
    "keyframes/covariances": ("f8", ("keyframes", 3, 3)),
    "keyframes/innovations": ("f8", ("keyframes", 3)),
    "keyframes/origins": ("f8", ("keyframes", 2)),
    "keyframes/starts": ("i8", ("starts",)),
    "keyframes/points": ("f4", ("points", 2)),
    "landmarks": ("u1", ("bytes",)),  # JSON
}
_EDGES: archive.Layout = {
    "edges/i": ("i8", ("edges",)),
    "edges/j": ("i8", ("edges",)),
    "edges/T_i_j": ("f8", ("edges", 3)),
    "edges/information": ("f8", ("edges", 3, 3)),
    "edges/kernel": ("f8", ("edges",)),
}
_KEYFRAMES = tuple(f.name for f in fields(Keyframes))
_COLUMNS = tuple(name for name in _LAYOUT if "/" not in name and name != "landmarks")


def _layout(version: int) -> archive.Layout:
    """Return the arrays of a version's files; the first one had no edges."""
    return _LAYOUT if version < 2 else {**_LAYOUT, **_EDGES}


def _to_arrays(known: Map) -> dict[str, np.ndarray[Any, Any]]:
    arrays = {name: getattr(known, name) for name in _COLUMNS}
    arrays |= {f"keyframes/{name}": getattr(known.keyframes, name) for name in _KEYFRAMES}
    marks = [asdict(landmark) for landmark in known.landmarks]
    arrays |= {f"edges/{name}": array for name, array in known.edges._asdict().items()}
    text = json.dumps(marks, default=lambda array: array.tolist())
    return {**arrays, "landmarks": np.frombuffer(text.encode(), np.uint8)}


def _from_arrays(arrays: dict[str, np.ndarray[Any, Any]], about: dict[str, Any]) -> Map:
    keyframes = Keyframes(**{name: arrays[f"keyframes/{name}"] for name in _KEYFRAMES})
    _check_places(keyframes, arrays["anchors"])
    edges = _edges(arrays, len(keyframes))
    marks = tuple(_landmark(m) for m in json.loads(arrays["landmarks"].tobytes()))
    return Map(
        keyframes, marks, **{name: arrays[name] for name in _COLUMNS}, edges=edges, about=about
    )


def _check_places(keyframes: Keyframes, anchors: Ints) -> None:
    """Raise an error for indices out of bounds, which compiled code does not check."""
    starts = keyframes.starts
    if len(starts) != len(keyframes) + 1 or starts[0] != 0 or starts[-1] != len(keyframes.points):
        raise ValueError("keyframes/starts does not fit the points")
    if (np.diff(starts) < 0).any():
        raise ValueError("keyframes/starts falls")
    if ((anchors < 0) | (anchors >= len(keyframes))).any():
        raise ValueError("anchors are no keyframes")


def _edges(arrays: dict[str, np.ndarray[Any, Any]], keyframes: int) -> Edges:
    """Return the edges; raise an error for one that does not join two keyframes, or has no sense."""
    if "edges/i" not in arrays:
        return NO_EDGES
    edges = Edges(*(arrays[f"edges/{name}"] for name in Edges._fields))
    ends = np.stack([edges.i, edges.j])
    if ((ends < 0) | (ends >= keyframes)).any() or (edges.i == edges.j).any():
        raise ValueError("edges do not join two keyframes")
    if not (np.isfinite(edges.T_i_j).all() and np.isfinite(edges.information).all()):
        raise ValueError("edges are not finite")
    if not (edges.kernel > 0.0).all():
        raise ValueError("edges/kernel is not positive")
    return edges


def _landmark(mark: dict[str, Any]) -> Landmark:
    known = Landmark(**mark)
    position, covariance = (np.array(v, np.float64) for v in (known.position, known.covariance))
    ends = known.end_points if known.end_points is None else np.array(known.end_points, np.float64)
    check_shape("position", position, 2)
    check_shape("covariance", covariance, len(covariance), len(covariance))
    if ends is not None:
        check_shape("end_points", ends, 2, 2)
    if not isinstance(known.kind, str) or not isinstance(known.parameters, dict):
        raise TypeError("a landmark has no kind, or no parameters")
    return replace(
        known,
        id=int(known.id),
        observations=int(known.observations),
        first_stamp=float(known.first_stamp),
        last_stamp=float(known.last_stamp),
        position=position,
        covariance=covariance,
        end_points=ends,
    )
