"""Ground truth of the corridor: compare observations and landmarks with the true scene."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from impslam.geometry.se2 import rotation, transform
from impslam.simulation.drive import drive
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene, distance_to_segments
from impslam.simulation.world import World, load_world
from impslam.studies.ground_truth import TracedSweep, trace_sweep
from impslam.sweeps.cases import ROBOT
from impslam.types import Array, Landmark, Mask, Observation

MIN_BEAM_SHARE = 0.5
"""Share of an observation's beams that must hit a thing to assign it."""
MAX_RECESS = 0.12
"""m: parallel faces closer than this are one plane; the doors' leaves are set back by up to 0.10 m."""
MAX_RECESS_TURN = math.radians(1.0)
"""rad: the same for their directions."""
MAX_WALL_TURN = math.radians(10.0)
"""rad between an observed wall and a true one: a bin of the thesis's Hough transform (5.2.2)."""
MAX_WALL_OFFSET = 0.2
"""m between an observed wall and the plane that its beams hit: ten bins (5.2.2)."""
MAX_POINT_DISTANCE = 0.1
"""m between an observed cylinder or corner and a true one."""
PERSON_RADIUS = 0.4
"""m: an observation this close to the middle of a person, and of nothing else, is of the person."""
MAX_LANDMARK_OFFSET = 0.25
"""m: a landmark of the final map that is further from all true things is false."""
MAX_LANDMARK_TURN = math.radians(5.0)
"""rad: the same for the direction of walls."""


@dataclass(frozen=True, slots=True)
class Classification:
    """Classification of an observation.

    Attributes
    ----------
    person : it is of a person: at least half of its beams hit people, or it is within `PERSON_RADIUS` of
        the middle of one and not within `MAX_POINT_DISTANCE` of anything static
    touched : any of its beams hit people
    false : nothing of its kind is there; for walls, see `is_wall`
    """

    person: bool
    touched: bool
    false: bool


class CorridorTruth:
    """The world at any time of the drive, for a lidar of the simulated robot."""

    def __init__(self, world: World, lidar: Lidar) -> None:
        self.lidar, self.scene, self.path = lidar, Scene(world), drive(world.robot)
        self.duration = lidar.beam_time * (lidar.beams - 1)  # of a sweep, s

    def sweep(self, time: float) -> TracedSweep:
        """Return the sweep that began at a time in s since the start of the run."""
        return trace_sweep(self.scene, self.lidar, self.path, time)


@functools.cache
def corridor_world() -> World:
    """Return the world."""
    return load_world("corridor")


@functools.cache
def corridor_truth() -> CorridorTruth:
    """Return the ground truth for the lidar of the simulated robot."""
    assert ROBOT.lidar is not None
    return CorridorTruth(corridor_world(), ROBOT.lidar)


def judge(sweep: TracedSweep, seen: Observation) -> Classification:
    """Classify an observation by comparison with the true things, at the robot's true pose."""
    on_people = sweep.hits[seen.beams] >= len(sweep.round) - len(sweep.legs)
    position = _position(sweep.pose, seen)
    gaps = np.hypot(*(_people(sweep) - position).T)
    near = bool((gaps < PERSON_RADIUS).any()) and (_clearance(sweep, position) > MAX_POINT_DISTANCE)
    return Classification(
        near or bool(on_people.mean() >= MIN_BEAM_SHARE),
        bool(on_people.any()),
        not (is_wall(sweep, seen) if seen.kind == "wall" else _is_point(sweep, seen, position)),
    )


def _people(sweep: TracedSweep) -> Array:
    """Return the positions (k, 2) of people, m, in map: the middles between their legs."""
    return np.asarray(0.5 * (sweep.legs[0::2, :2] + sweep.legs[1::2, :2]))


def _static_circles(sweep: TracedSweep) -> Array:
    """Return the static circles (c, 3), m, in map: all but legs."""
    circles = sweep.round[: len(sweep.round) - len(sweep.legs)]
    return circles[np.isfinite(circles[:, 0])]


def is_wall(sweep: TracedSweep, seen: Observation) -> bool:
    """Return whether at least half of a wall's beams hit one plane, and the wall lies in it.

    The tolerances are `MAX_WALL_TURN`, and `MAX_WALL_OFFSET` at the middle between the end points. Parallel
    faces within `MAX_RECESS` are one plane: a wall with its closed doors, not the sides of a passage.
    """
    hits = sweep.hits[seen.beams]
    which, times = np.unique(hits[hits >= 0], return_counts=True)
    faces = sweep.straight[which]
    faces, times = faces[np.isfinite(faces[:, 0])], times[np.isfinite(faces[:, 0])]
    if not len(faces):
        return False
    together = [int(times[_coplanar(faces, face)].sum()) for face in faces]
    votes, _, best = max(zip(together, times.tolist(), range(len(faces)), strict=True))
    face = faces[best]
    turn = _between(float(seen.z[1] + sweep.pose[2] + 0.5 * math.pi), _direction(face))
    aside = abs(_aside(_position(sweep.pose, seen)[None], face)[0])
    return (
        votes >= MIN_BEAM_SHARE * len(hits) and turn <= MAX_WALL_TURN and aside <= MAX_WALL_OFFSET
    )


def _is_point(sweep: TracedSweep, seen: Observation, position: Array) -> bool:
    known = _static_circles(sweep)[:, :2] if seen.kind == "cylinder" else _ends(sweep.straight)
    return bool((np.hypot(*(known - position).T) <= MAX_POINT_DISTANCE).any())


def _position(pose: Array, seen: Observation) -> Array:
    """Return the position of an observation in map: a point, or the middle of a wall."""
    at = seen.z if seen.end_points is None else seen.end_points.mean(axis=0)
    position: Array = transform(pose, at[None, :2])[0]
    return position


def _clearance(sweep: TracedSweep, position: Array) -> float:
    """Return the distance of a position (2,) from the static scene and doors, m."""
    straight = sweep.straight[np.isfinite(sweep.straight[:, 0])]
    circles = _static_circles(sweep)
    gaps = np.hypot(*(circles[:, :2] - position).T) - circles[:, 2]
    return float(min(distance_to_segments(position, straight).min(), *np.maximum(gaps, 0.0)))


def _ends(straight: Array) -> Array:
    return straight[np.isfinite(straight[:, 0])].reshape(-1, 2)


def _direction(face: Array) -> float:
    return math.atan2(face[3] - face[1], face[2] - face[0])


def _between(a: float, b: float) -> float:
    """Return the angle between two lines, in [0, pi / 2]."""
    off = abs(a - b) % math.pi
    return min(off, math.pi - off)


def _aside(points: Array, face: Array) -> Array:
    """Return the signed distances (n,) of points (n, 2) from the line through a face (4,)."""
    along = (face[2:] - face[:2]) / math.hypot(*(face[2:] - face[:2]))
    off: Array = (points - face[:2]) @ np.array([-along[1], along[0]])
    return off


def _coplanar(rows: Array, face: Array) -> Mask:
    """Return (n,) which of the faces (n, 4) lie in the plane of a face (4,)."""
    off = np.arctan2(rows[:, 3] - rows[:, 1], rows[:, 2] - rows[:, 0]) - _direction(face)
    near = np.abs(_aside(0.5 * (rows[:, :2] + rows[:, 2:]), face)) <= MAX_RECESS
    return np.asarray(near & (np.abs(np.sin(off)) <= math.sin(MAX_RECESS_TURN)))


def false_landmarks(truth: CorridorTruth, landmarks: tuple[Landmark, ...]) -> tuple[int, ...]:
    """Return the ids of landmarks of a map without a true thing of their kind at their position.

    Doors' leaves count in all positions that they take during the drive.
    """
    scene = truth.scene
    leaves = [scene.leaves(t) for t in np.arange(0.0, truth.path.duration, 0.5)]
    straight = np.unique(np.vstack([scene.segments, *leaves]), axis=0)
    return tuple(mark.id for mark in landmarks if not _exists(mark, straight, scene.circles))


def _exists(mark: Landmark, straight: Array, circles: Array) -> bool:
    if mark.end_points is None:
        known = circles[:, :2] if mark.kind == "cylinder" else straight.reshape(-1, 2)
        return bool((np.hypot(*(known - mark.position).T) <= MAX_LANDMARK_OFFSET).any())
    middle = mark.end_points.mean(axis=0)
    along = mark.end_points[1] - mark.end_points[0]
    turn = math.atan2(along[1], along[0])
    back = rotation(turn).T
    for face in straight:
        offset = abs(_aside(middle[None], face)[0])
        if _between(turn, _direction(face)) > MAX_LANDMARK_TURN or offset > MAX_LANDMARK_OFFSET:
            continue
        one = np.sort((mark.end_points @ back.T)[:, 0])
        two = np.sort((face.reshape(2, 2) @ back.T)[:, 0])
        if min(one[1], two[1]) >= max(one[0], two[0]):
            return True
    return False
