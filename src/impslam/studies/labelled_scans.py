"""Simulated scans with labelled beams, which give the landmarks visible in each scan.

A beam's label is the thing that an exact ray hits from the laser's pose at the beam's own time, in the
scene that produced the ranges. A wall divided by doors or cylinders is one thing; each side of a box,
leaf, jamb, wall of a room behind a door, and leg is a thing of its own.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import inverse, transform
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.drive import Trajectory, drive
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.simulation.world import Drive, World
from impslam.studies.ground_truth import TracedSweep, trace_sweep, true_twist
from impslam.studies.passers_by import passing
from impslam.types import Array, Ints, LaserScan, Scan

MIN_BEAMS = {"wall": 10, "cylinder": 5}
"""Beams on a visible thing: a tenth of an arena's wall; three points define a circle, two more verify
it."""
MIN_SPAN = 0.3
"""m between the first and the last point hit by beams on a visible wall."""
LANDMARKS = ("wall", "room", "cylinder")
"""Permanent things that extractors should find."""
EDGE = 0.1  # share of half the angular width of a circle that may be missing at an edge


@dataclass(frozen=True, slots=True)
class Condition:
    """Conditions of scans: the lidar, stationary or driving, and the number of people in sight."""

    name: str
    lidar: Lidar
    driving: bool
    people: int


STANDING = Condition(
    "standing",
    Lidar(bias_sigma=0.0, resolution=0.0, divergence=0.0, dropout=0.0),
    driving=False,
    people=0,
)
DRIVING = Condition("driving", Lidar(), driving=True, people=0)
PEOPLE = Condition("people", Lidar(), driving=True, people=2)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A thing hit by beams of a scan, in base_link at the middle of the sweep.

    Attributes
    ----------
    thing : "wall", "door", "cylinder", "person", ...: see `impslam.simulation.scene.Thing`
    kind : "wall" for straight things, "cylinder" for round ones
    z : (2,) an observation without error
    radius : m; NaN for straight things
    ends : (2, 2) m, first and last point hit by beams
    beams : valid beams that hit it
    whole : for round things, whether it is visible from edge to edge
    """

    thing: str
    kind: str
    z: Array
    radius: float
    ends: Array
    beams: Ints
    whole: bool = False

    @property
    def visible(self) -> bool:
        """Whether it is a landmark of which enough is visible to be found."""
        long = self.kind != "wall" or math.dist(*self.ends) >= MIN_SPAN
        return self.thing in LANDMARKS and len(self.beams) >= MIN_BEAMS[self.kind] and long


@dataclass(frozen=True, slots=True, eq=False)
class LabelledScan:
    """A scan, the things seen in it, and its true beams.

    Attributes
    ----------
    origins, directions : (n, 2) m and (n,) rad, as in the scan, but by the exact motion
    sigmas : (n,) m, true noise of the ranges
    bias : m, true standard deviation of the common error of all beams
    """

    scan: Scan
    seen: tuple[Seen, ...]
    origins: Array
    directions: Array
    sigmas: Array
    bias: float


def labelled_scans(
    world: World, condition: Condition, seed: int, count: int
) -> Iterator[LabelledScan]:
    """Yield scans at times spread evenly over the drive, the same for every condition.

    Each scan is from a new lidar, so that the common errors of its beams are independent between scans.
    """
    streams = np.random.SeedSequence([seed, zlib.crc32(world.name.encode())]).spawn(3)
    times, noise, walkers = (np.random.default_rng(stream) for stream in streams)
    standing = world.model_copy(update={"people": ()})
    trajectory = _trajectory(world.robot)
    sweep = condition.lidar.beam_time * condition.lidar.beams
    scene = Scene(standing)
    for number in range(count):
        time = (number + float(times.random())) / count * (trajectory.duration - sweep)
        path = trajectory if condition.driving else _stopped(trajectory, time)
        if condition.people:
            around = path.at(np.array([time]))[0]
            people = passing(scene, around, time, condition.people, walkers)
            crowded = standing.model_copy(update={"people": people})
            yield take(Scene(crowded), path, time, condition.lidar, noise)
        else:
            yield take(scene, path, time, condition.lidar, noise)


@lru_cache(maxsize=8)
def _trajectory(plan: Drive) -> Trajectory:
    return drive(plan)


def _stopped(trajectory: Trajectory, time: float) -> Trajectory:
    """Return the trajectory of a robot that is stationary at this one's pose at a time."""
    (pose,) = trajectory.at(np.array([time]))
    return Trajectory(
        np.array([0.0, trajectory.duration]), np.stack((pose, pose)), np.zeros((1, 2))
    )


def take(
    scene: Scene, path: Trajectory, time: float, lidar: Lidar, rng: np.random.Generator
) -> LabelledScan:
    """Return the sweep that begins at a time, de-skewed with the true motion, and its labels."""
    simulator = LidarSimulator(lidar, scene, path, rng)
    message = LaserScan(
        time, simulator.angles, simulator.ranges(time), simulator.time_offsets, *simulator.limits
    )
    sensor = Lidar2D(
        mount=lidar.mount,
        sigma=max(lidar.sigma, 1e-9),
        sigma_per_m=lidar.sigma_rate,
        bias=lidar.bias_sigma,
    )
    scan = sensor.scan(message, true_twist(path, time, time + simulator.duration))
    sweep = trace_sweep(scene, lidar, path, time)
    hits = np.where(scan.valid, sweep.hits, -1)
    origins, directions = _seen_from(sweep.pose, sweep.lasers, sweep.angles)
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    points = origins + sweep.ranges[:, None] * beams
    seen = tuple(
        _seen(scene.things[k].kind, sweep, k, on, points[on], scan) for k, on in _hit(scene, hits)
    )
    sigmas = lidar.sigma + lidar.sigma_rate * sweep.ranges
    return LabelledScan(scan, seen, origins, directions, sigmas, lidar.bias_sigma)


def _seen(
    thing: str, sweep: TracedSweep, which: int, beams: Ints, points: Array, scan: Scan
) -> Seen:
    """Return a thing hit by beams at points (n, 2) in base_link."""
    T_base_map = inverse(sweep.pose)
    if np.isfinite(sweep.round[which, 0]):
        return _round(thing, sweep.round[which], beams, points, T_base_map, scan)
    return _straight(thing, sweep.straight[which], beams, points, T_base_map, scan)


def _seen_from(pose: Array, lasers: Array, angles: Array) -> tuple[Array, Array]:
    """Return origins (n, 2) and directions (n,) of beams of lasers in map (n, 3) from a pose."""
    return transform(inverse(pose), lasers[:, :2]), wrap(lasers[:, 2] + angles - pose[2])


def _hit(scene: Scene, hits: Ints) -> list[tuple[int, Ints]]:
    """Return the first piece of each thing that was hit, and the beams that hit any of its pieces."""
    pieces: dict[Hashable, list[int]] = {}
    for which in np.unique(hits[hits >= 0]).tolist():
        thing = scene.things[which]
        pieces.setdefault(thing if thing.kind == "wall" else which, []).append(which)
    return [(these[0], np.flatnonzero(np.isin(hits, these))) for these in pieces.values()]


def _straight(
    thing: str, row: Array, beams: Ints, points: Array, T_base_map: Array, scan: Scan
) -> Seen:
    start, end = transform(T_base_map, row.reshape(2, 2))
    tangent = (end - start) / np.hypot(*(end - start))
    normal = np.array([tangent[1], -tangent[0]])
    rho = float(normal @ start)
    if float(normal @ scan.laser[:2]) > rho:
        rho, normal = -rho, -normal
    along = points @ tangent
    ends = rho * normal + np.array([[along.min()], [along.max()]]) * tangent
    z = np.array([rho, wrap(math.atan2(normal[1], normal[0]))])
    return Seen(thing, "wall", z, math.nan, ends, beams)


def _round(
    thing: str, row: Array, beams: Ints, points: Array, T_base_map: Array, scan: Scan
) -> Seen:
    centre, radius = transform(T_base_map, row[None, :2])[0], float(row[2])
    whole = _edge_to_edge(centre - scan.laser[:2], radius, points - scan.laser[:2], scan)
    return Seen(thing, "cylinder", centre, radius, points[[0, -1]], beams, whole)


def _edge_to_edge(sight: Array, radius: float, points: Array, scan: Scan) -> bool:
    """Return whether the outermost beams on a circle are as close to its edges as possible."""
    bearings = np.arctan2(points[:, 1], points[:, 0]) - math.atan2(sight[1], sight[0])
    off, half = wrap(bearings), math.asin(min(1.0, radius / float(np.hypot(*sight))))
    least = (1.0 - EDGE) * half - abs(float(scan.angles[1] - scan.angles[0]))
    return bool(off.max() >= least and off.min() <= -least)
