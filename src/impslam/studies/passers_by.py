"""Place people who walk past the robot, wherever there is room for them."""

from __future__ import annotations

import math

import numpy as np

from impslam.simulation.raycast import trace
from impslam.simulation.scene import Scene
from impslam.simulation.world import Person
from impslam.types import Array

CLEARANCE = 0.25  # m, between people and walls or the robot's middle
MIN_DISTANCE, MAX_DISTANCE = 0.7, 3.5  # m, of people from the robot
SPEED = 1.2  # m/s, of people
MAX_TRIES = 1000  # positions drawn before fewer people are accepted


def passing(
    scene: Scene, pose: Array, time: float, count: int, rng: np.random.Generator
) -> tuple[Person, ...]:
    """Return people in sight of the robot at a time, each walking in a random direction."""
    people: list[Person] = []
    for _ in range(MAX_TRIES):
        if len(people) == count:
            break
        bearing, part = rng.uniform(-math.pi, math.pi), rng.random()
        squares = MIN_DISTANCE**2, MAX_DISTANCE**2
        away = math.sqrt(squares[0] + part * (squares[1] - squares[0]))  # uniform over the area
        sight = np.array([*pose[:2], bearing])
        free = _is_line_of_sight_free(scene, sight, time, away + CLEARANCE)
        position = pose[:2] + away * np.array([math.cos(bearing), math.sin(bearing)])
        if free and scene.clearance(position, time) > CLEARANCE:
            people.append(walker(position, time, rng.uniform(-math.pi, math.pi)))
    return tuple(people)


def _is_line_of_sight_free(scene: Scene, sight: Array, time: float, length: float) -> bool:
    standing, moving = (scene.segments, scene.circles), scene.moving(time, time)
    ranges, _, _ = trace(sight[None], np.zeros(1), np.zeros(1), standing, moving, length)
    return bool(np.isinf(ranges[0]))


def walker(position: Array, time: float, heading: float) -> Person:
    """Return a person who passes a position at a time."""
    walked = min(1.0, SPEED * time)  # less at the beginning of the run
    step = np.array([math.cos(heading), math.sin(heading)])
    (x0, y0), (x1, y1) = (position - walked * step).tolist(), (position + step).tolist()
    start = time - walked / SPEED if walked < SPEED * time else 0.0
    return Person(waypoints=((x0, y0), (x1, y1)), start=start, speed=SPEED)
