"""Simulated scans with ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from impslam.columns import single_row
from impslam.config import load
from impslam.extractors.readings import usable
from impslam.geometry.se2 import transform
from impslam.simulation.drive import drive
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.scene import Scene
from impslam.simulation.simulate import sweep_times
from impslam.simulation.world import Person, World, load_world
from impslam.studies.ground_truth import true_twist
from impslam.types import Array, LaserScan, Scan

RATE = 1.0
"""Hz: every tenth scan of the lidar; the scene hardly changes in between."""
MIN_WALL = 0.5
"""m: shorter flat things (jambs of doors) are not walls."""
HALF_DOORWAY = 0.45
"""m: walls are extended by this, so that a line across an open door belongs to the wall beside it."""
LEG_DISTANCE = 0.05
"""m: readings closer to a leg's surface are of it: five times the range noise at 2 m."""
CLEAR = 1.0
"""m: a person closer to the robot would hide everything else."""
ARENA, CORRIDOR, PEOPLE = "arena", "corridor", "arena with people"
WALKERS = (
    Person(waypoints=((-1.4, 4.3), (0.1, 4.3)), speed=0.8, returns=True),
    Person(waypoints=((-0.75, 0.6), (-0.75, 2.6)), speed=0.8, returns=True),
)
"""Two people who pace the arena: one across it, one beside the first cylinder."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneSnapshot:
    """A scan and the true scene at its middle.

    `pose` (3,) is `T_map_base`. In map: `surfaces` (s, 4) m are the flat things that count as walls (walls,
    doors and the walls of rooms behind them, but not boxes; see `select_walls`), `leaves` (l, 4) m those of
    opening doors, `legs` (k, 3) m x, y and radius, two for each person.
    """

    number: int
    time: float
    scan: Scan
    pose: Array
    scene: Scene
    surfaces: Array
    leaves: Array
    legs: Array

    @property
    def on_legs(self) -> int:
        """Number of readings on people's legs."""
        points = transform(self.pose, self.scan.points[usable(self.scan)])
        gaps = np.hypot(*(points[:, None] - self.legs[None, :, :2]).T) - self.legs[:, 2, None]
        return int((np.abs(gaps) <= LEG_DISTANCE).any(axis=0).sum())

    @property
    def is_clear(self) -> bool:
        """Whether no person is closer to the robot than `CLEAR`."""
        return bool((np.hypot(*(self.legs[:, :2] - self.pose[:2]).T) >= CLEAR).all())


def world_of(name: str) -> World:
    """Return a shipped world, or the arena with people."""
    if name == PEOPLE:
        return load_world(ARENA).model_copy(update={"name": PEOPLE, "people": WALKERS})
    return load_world(name)


def snapshots(world: World, seed: int = 0) -> Iterator[SceneSnapshot]:
    """Yield the scans of a run at `RATE` from the thesis's sensor, de-skewed with the true motion."""
    sensor = load("thesis-points").make_robot().sensors["lidar"]
    robot = SimulatedRobot(lidar=Lidar(rate=RATE))
    assert robot.lidar is not None
    trajectory, scene = drive(world.robot), Scene(world)
    without_boxes = Scene(world.model_copy(update={"boxes": ()}))
    walls = select_walls(without_boxes.segments)
    lidar = LidarSimulator(robot.lidar, scene, trajectory, np.random.default_rng(seed))
    for number, time in enumerate(sweep_times(robot, trajectory).tolist()):
        message = LaserScan(time, lidar.angles, lidar.ranges(time), lidar.time_offsets)
        (columns,) = single_row("lidar", message, number).values()
        twist = true_twist(trajectory, *np.concatenate(sensor.spans(columns)).tolist())
        scans = sensor.sweeps(columns, twist[None])
        assert scans is not None
        scan = scans.row(0)
        middle = time + 0.5 * lidar.duration
        pose = trajectory.at(np.array([middle]))[0]
        leaves, legs = scene.leaves(middle), scene.legs(middle)
        surfaces = np.vstack([walls, select_walls(leaves)])
        yield SceneSnapshot(number, time, scan, pose, scene, surfaces, leaves, legs)


def select_walls(segments: Array) -> Array:
    """Return the segments (s, 4) m that are long enough for a wall, extended by half a doorway."""
    along = segments[:, 2:] - segments[:, :2]
    lengths = np.hypot(*along.T)
    extension = HALF_DOORWAY * along / lengths[:, None]
    return np.asarray((segments + np.hstack([-extension, extension]))[lengths >= MIN_WALL])
