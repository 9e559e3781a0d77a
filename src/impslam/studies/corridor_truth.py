"""What truly stands in the corridor where an observation or a landmark says that something does."""

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

MOSTLY = 0.5
"""Share of an observation's beams from which on it rests on what they hit."""
RECESS = 0.12
"""m: parallel faces nearer than this are one plane; the doors' leaves are up to 0.10 m set back."""
PARALLEL = math.radians(1.0)
"""rad: likewise for their directions."""
TURNED = math.radians(10.0)
"""rad: a wall seen more than a bin of the thesis's Hough transform (5.2.2) off what it is none."""
ASIDE = 0.2
"""m: a wall seen so far off the plane that its beams hit is none; ten bins (5.2.2)."""
POINT = 0.1
"""m: a cylinder or a corner seen so far from every true one is none."""
PERSON = 0.4
"""m: what is seen so near the middle of a person, and is nothing else, is the person."""
ASTRAY = 0.25
"""m: a landmark of the final map so far from all that stands is false."""
ASKEW = math.radians(5.0)
"""rad: likewise for the direction of walls."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What an observation is.

    Attributes
    ----------
    person : it rests on someone: half its beams or more hit people, or it lies within `PERSON` of
        the middle of one and not within `POINT` of anything that stands
    touched : any of its beams hit people
    false : nothing of its kind is there; of a wall, see `is_wall`
    """

    person: bool
    touched: bool
    false: bool


class CorridorTruth:
    """The world at any time of the drive, as a lidar of the simulated robot meets it."""

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
    """Return what is there, for the lidar of the robot that drives."""
    assert ROBOT.lidar is not None
    return CorridorTruth(corridor_world(), ROBOT.lidar)


def judge(sweep: TracedSweep, seen: Observation) -> Verdict:
    """Compare an observation with the true things, in the robot's true frame."""
    on_people = sweep.hits[seen.beams] >= len(sweep.round) - len(sweep.legs)
    place = _place(sweep.pose, seen)
    gaps = np.hypot(*(_people(sweep) - place).T)
    near = bool((gaps < PERSON).any()) and _clearance(sweep, place) > POINT
    return Verdict(
        near or bool(on_people.mean() >= MOSTLY),
        bool(on_people.any()),
        not (is_wall(sweep, seen) if seen.kind == "wall" else _is_point(sweep, seen, place)),
    )


def _people(sweep: TracedSweep) -> Array:
    """Return the middles (k, 2) between people's legs, m, in map."""
    return np.asarray(0.5 * (sweep.legs[0::2, :2] + sweep.legs[1::2, :2]))


def _standing(sweep: TracedSweep) -> Array:
    """Return the circles (c, 3) that stand, m, in map: all that is round but legs."""
    circles = sweep.round[: len(sweep.round) - len(sweep.legs)]
    return circles[np.isfinite(circles[:, 0])]


def is_wall(sweep: TracedSweep, seen: Observation) -> bool:
    """Return whether half of a wall's beams or more hit one plane, and the wall lies in it.

    Within `TURNED`, and within `ASIDE` at the middle between the wall's end points. Parallel faces
    not `RECESS` apart are one plane: a wall with its closed doors, not the sides of a passage.
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
    aside = abs(_aside(_place(sweep.pose, seen)[None], face)[0])
    return votes >= MOSTLY * len(hits) and turn <= TURNED and aside <= ASIDE


def _is_point(sweep: TracedSweep, seen: Observation, place: Array) -> bool:
    known = _standing(sweep)[:, :2] if seen.kind == "cylinder" else _ends(sweep.straight)
    return bool((np.hypot(*(known - place).T) <= POINT).any())


def _place(pose: Array, seen: Observation) -> Array:
    """Return where an observation is in map: a point, or the middle of a wall."""
    at = seen.z if seen.end_points is None else seen.end_points.mean(axis=0)
    place: Array = transform(pose, at[None, :2])[0]
    return place


def _clearance(sweep: TracedSweep, place: Array) -> float:
    """Return how far a place (2,) is from all that stands or hangs, m."""
    straight = sweep.straight[np.isfinite(sweep.straight[:, 0])]
    circles = _standing(sweep)
    gaps = np.hypot(*(circles[:, :2] - place).T) - circles[:, 2]
    return float(min(distance_to_segments(place, straight).min(), *np.maximum(gaps, 0.0)))


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
    """Return which of the faces (n, 4) lie in the plane of one."""
    off = np.arctan2(rows[:, 3] - rows[:, 1], rows[:, 2] - rows[:, 0]) - _direction(face)
    near = np.abs(_aside(0.5 * (rows[:, :2] + rows[:, 2:]), face)) <= RECESS
    return np.asarray(near & (np.abs(np.sin(off)) <= math.sin(PARALLEL)))


def false_landmarks(truth: CorridorTruth, landmarks: tuple[Landmark, ...]) -> tuple[int, ...]:
    """Return the ids of those landmarks of a map where nothing of their kind stands.

    Doors' leaves count as shut, as open, and as walls whenever they can be seen so.
    """
    scene = truth.scene
    leaves = [scene.leaves(t) for t in np.arange(0.0, truth.path.duration, 0.5)]
    straight = np.unique(np.vstack([scene.segments, *leaves]), axis=0)
    return tuple(mark.id for mark in landmarks if not _stands(mark, straight, scene.circles))


def _stands(mark: Landmark, straight: Array, circles: Array) -> bool:
    if mark.end_points is None:
        known = circles[:, :2] if mark.kind == "cylinder" else straight.reshape(-1, 2)
        return bool((np.hypot(*(known - mark.position).T) <= ASTRAY).any())
    middle = mark.end_points.mean(axis=0)
    along = mark.end_points[1] - mark.end_points[0]
    turn = math.atan2(along[1], along[0])
    back = rotation(turn).T
    for face in straight:
        if _between(turn, _direction(face)) > ASKEW or abs(_aside(middle[None], face)[0]) > ASTRAY:
            continue
        one = np.sort((mark.end_points @ back.T)[:, 0])
        two = np.sort((face.reshape(2, 2) @ back.T)[:, 0])
        if min(one[1], two[1]) >= max(one[0], two[0]):
            return True
    return False
