"""Map and score the real logs, for the tests on real logs and the tables of results.

The logs and their truths are not part of the project; each function takes their folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from impslam.cli.job import execute
from impslam.cli.run_folder import run_folder
from impslam.columns import messages
from impslam.evaluation.landmarks import LandmarkScore, score_landmarks
from impslam.evaluation.relations import RelationErrors, read_relations, relation_errors
from impslam.evaluation.trajectory import Statistics, align, associate, ate
from impslam.geometry.se2 import between, compose, inverse, transform
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.open_log import open_log
from impslam.run import Run as Course
from impslam.run import map_log
from impslam.sources.base import recognise
from impslam.types import Array, Landmark, OdometryPose, TrueLandmark


@dataclass
class Run(Observer):
    """The data of a run for scoring; poses as rows (n, 4) of stamp, x, y, theta."""

    ends: list[tuple[int, list[Array]]] = field(default_factory=list)
    known: Map | None = None
    outcome: Outcome | None = None
    scans: int = 0

    def follow(self, track: Track, path: PathRows) -> None:
        """Count the scans."""
        self.scans += len(path.stamps)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Store the ends of the observed walls, in base_link, with the number of the scan."""
        ends = [o.end_points for o in keyframe.observations if o.end_points is not None]
        self.ends.append((self.scans, ends))
        self.scans += 1

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Store the map and the outcome."""
        self.known, self.outcome = known, outcome

    @property
    def path(self) -> Array:
        """The path (n, 4)."""
        assert self.known is not None
        return self.known.path()

    @property
    def wheels(self) -> Array:
        """Dead reckoning (n, 4)."""
        assert self.known is not None
        return self.known.odometry()

    @property
    def covariance(self) -> Array:
        """(3, 3) of the last pose."""
        assert self.known is not None
        return self.known.rows().covariances[-1]

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The final map."""
        assert self.known is not None
        return self.known.landmarks

    @property
    def speed(self) -> float:
        """Speed relative to real time."""
        assert self.outcome is not None
        return self.outcome.log_seconds / self.outcome.wall_seconds


def run_log(
    log: Path, base: str | None = None, settings: Sequence[str] = (), folder: Path | None = None
) -> Run:
    """Map a log with the preset that fits it, or another one; write a run folder if given one."""
    config, source = open_log(log, base, settings)
    seen = Run()
    if folder is None:
        map_log(config, source, [seen])
    else:
        with run_folder(folder, log.name, force=True) as made:
            execute(config, source, made, quiet=True, more=[seen])
    return seen


def final_covariance(log: Path) -> Array:
    """Return the joint covariance of pose and map at the end of a log, by the landmark filter."""
    config, source = open_log(log, settings=["estimator.kind=landmarks"])
    course = Course(config)
    with source:
        for batch in source.batches():
            course.feed(batch)
    course.flush()
    covariance: Array = course.estimator._filter.belief.covariance  # type: ignore[attr-defined]  # EKF's
    return covariance


# --------------------------------------------------------------------------- against the truth


@dataclass(frozen=True)
class Score:
    """A run against a known path and known cylinders, both after the same rigid alignment."""

    path: Statistics
    wheels: Statistics  # of dead reckoning from the same start, not aligned by itself
    cylinders: LandmarkScore

    @property
    def cylinder_rms(self) -> float:
        """Root mean square of the distances of the cylinders found, m."""
        return math.sqrt(float(np.mean([e.distance**2 for e in self.cylinders.found])))


def score(seen: Run, truth: Array, centres: Array) -> Score:
    """Score a run against true poses (n, 4) and the true centres (k, 2) of cylinders."""
    pairs = associate(seen.path, truth)
    T_map_truth = align(pairs.truth[:, :2], pairs.estimate[:, :2])
    known = [
        TrueLandmark(f"cylinder {i}", "cylinder", place, {})
        for i, place in enumerate(transform(T_map_truth, centres), 1)
    ]
    alone = associate(seen.wheels, truth).moved(inverse(T_map_truth))
    return Score(ate(pairs), ate(alone, aligned=False), score_landmarks(seen.landmarks, known))


def turtlebot3(data: Path, folder: Path | None = None) -> tuple[Run, Score]:
    """Map the TurtleBot3's bag by its wheels; its /odom is the simulator's truth."""
    log = data / "turtlebot3" / "turtlebot3.bag"
    seen = run_log(log, "turtlebot3-waffle", folder=folder)
    with recognise(log)(path=log) as source:
        read = messages(source.batches())
        truth = [[m.stamp, *m.pose] for m in read if isinstance(m, OdometryPose)]
    grid = (-1.1, 0.0, 1.1)
    return seen, score(seen, np.array(truth), np.array([[x, y] for x in grid for y in grid]))


def lego(data: Path, out: Path | None = None) -> tuple[Run, Score]:
    """Map the LEGO robot's folder; the reference has positions only, in mm and ms."""
    folder = data / "lego-robot4"
    seen = run_log(folder, folder=out)
    rows = [line.split() for line in (folder / "robot4_reference.txt").read_text().splitlines()]
    truth = np.array([[int(t) / 1e3, int(x) / 1e3, int(y) / 1e3, 0.0] for _, t, x, y in rows])
    marks = (folder / "robot_arena_landmarks.txt").read_text().splitlines()
    centres = np.array([[float(w) / 1e3 for w in line.split()[2:4]] for line in marks if line])
    return seen, score(seen, truth, centres)


def relations(
    data: Path, name: str, folder: Path | None = None, settings: Sequence[str] = ()
) -> tuple[Run, RelationErrors, RelationErrors]:
    """Map a log of the SLAM benchmarking suite; return also its errors and those of odometry."""
    seen = run_log(data / name / f"{name}.log", settings=settings, folder=folder)
    known = read_relations(data / name / f"{name}.relations")
    path, wheels = seen.path, seen.wheels
    return seen, relation_errors(path, known), relation_errors(wheels, known)


LOCAL = 60.0
"""s between the poses of a local relation."""


def local_errors(data: Path, name: str, path: Array) -> RelationErrors:
    """Return the errors of a path (n, 4) in the relations between poses at most `LOCAL` s apart."""
    known = read_relations(data / name / f"{name}.relations")
    return relation_errors(path, known[np.abs(known[:, 1] - known[:, 0]) <= LOCAL])


# --------------------------------------------------------------------------- against itself

SAME_WALL = math.radians(10.0)
MAX_OFFSET = 0.6  # m: closer parallel walls are assumed to be the same
MIN_COMMON = 0.2  # m of a wall that both laps must show
MIN_LENGTH = 0.5  # m; shorter pieces may be the sides of things
MIN_SCAN_GAP = 4  # scans; closer ones are from the same place
NEARLY_ALL = ("keyframes.distance=0.05", "keyframes.angle=0.02")
"""Settings with which nearly every scan of a moving robot is a keyframe."""


Walls = dict[int, list[Array]]
"""End points (2, 2) m in map of the walls seen in each scan, by its number."""


def laps(log: Path, seen: Run) -> Walls:
    """Return the walls of nearly all scans of a log, also of those that are no keyframes of the run.

    The walls are found by a second run, and placed by the final path of `seen`.
    """
    every = run_log(log, settings=NEARLY_ALL)
    assert every.known is not None
    keyframes = every.known.keyframes
    # A keyframe is at the middle of its sweep, a row of the path at the stamp of the log.
    rows = np.abs(keyframes.stamps[:, None] - every.path[:, 0]).argmin(axis=1)
    within = between(every.path[rows, 1:], keyframes.poses)
    poses = compose(seen.path[rows, 1:], within)
    placed = zip(poses, every.ends, strict=True)
    return {k: [transform(pose, e) for e in ends] for pose, (k, ends) in placed}


def lap_offsets(walls: Walls, first: int, second: int) -> Array:
    """Return the distances of long walls seen from scan `second` on from those seen before `first`, m.

    For each wall of the second lap, the median over all walls of the first lap that run beside it,
    each taken in the middle of the stretch that both show: the nearest would flatter.
    """
    long = _long_walls(walls)
    before = np.array([wall for k, wall in long if k < first])
    return _all_apart((wall, before) for k, wall in long if k >= second)


def same_lap_offsets(walls: Walls, first: int, second: int) -> Array:
    """Return the same for walls of one lap against those seen in other scans of this lap, m.

    Scans fewer than `MIN_SCAN_GAP` apart are left out. What is seen within a lap has hardly any drift:
    this is how well single scans show a wall, and no map can bring two laps closer together.
    """
    long = _long_walls(walls)
    laps = [[(k, w) for k, w in long if k < first], [(k, w) for k, w in long if k >= second]]
    return _all_apart(
        (wall, np.array([w for j, w in lap if abs(j - k) >= MIN_SCAN_GAP]))
        for lap in laps
        for k, wall in lap
    )


def _long_walls(walls: Walls) -> list[tuple[int, Array]]:
    return [(k, w) for k, seen in walls.items() for w in seen if _length(w) > MIN_LENGTH]


def _all_apart(walls: Iterable[tuple[Array, Array]]) -> Array:
    """Return the distances (m) of walls from others beside them; walls without others are left out."""
    offsets = [_apart(wall, others) for wall, others in walls if len(others)]
    return np.abs(np.array([offset for offset in offsets if offset is not None]))


def _apart(wall: Array, others: Array) -> float | None:
    """Return the median signed distance (m) of a wall (2, 2) from others (k, 2, 2) beside it."""
    along = (wall[1] - wall[0]) / _length(wall)
    normal = np.array([-along[1], along[0]])
    x, y = (others - wall[0]) @ along, (others - wall[0]) @ normal
    slope = np.diff(y)[:, 0] / np.diff(x)[:, 0]
    low, high = np.maximum(x.min(axis=1), 0.0), np.minimum(x.max(axis=1), _length(wall))
    offset = y[:, 0] + slope * (0.5 * (low + high) - x[:, 0])
    same = (high - low > MIN_COMMON) & (np.abs(slope) < SAME_WALL) & (np.abs(offset) < MAX_OFFSET)
    return float(np.median(offset[same])) if same.any() else None


def _length(wall: Array) -> float:
    return math.dist(wall[0], wall[1])
