"""People who walk past the robot, at any place where there is room for them."""

from __future__ import annotations

import math

import numpy as np

from impslam.simulation.raycast import trace
from impslam.simulation.scene import Scene
from impslam.simulation.world import Person
from impslam.types import Array

CLEARANCE = 0.25  # m, between people and walls or the robot's middle
NEAR, FAR = 0.7, 3.5  # m, how far from the robot people walk past
SPEED = 1.2  # m/s, of people
TRIES = 1000  # places drawn before a scan stays emptier than it should be


def passing(
    scene: Scene, pose: Array, time: float, count: int, rng: np.random.Generator
) -> tuple[Person, ...]:
    """Return people who are in sight of the robot at a time, each walking in some direction."""
    people: list[Person] = []
    for _ in range(TRIES):
        if len(people) == count:
            break
        bearing, part = rng.uniform(-math.pi, math.pi), rng.random()
        away = math.sqrt(NEAR**2 + part * (FAR**2 - NEAR**2))  # evenly over the area
        sight = np.array([*pose[:2], bearing])
        free = _free_way(scene, sight, time, away + CLEARANCE)
        place = pose[:2] + away * np.array([math.cos(bearing), math.sin(bearing)])
        if free and scene.clearance(place, time) > CLEARANCE:
            people.append(walker(place, time, rng.uniform(-math.pi, math.pi)))
    return tuple(people)


def _free_way(scene: Scene, sight: Array, time: float, length: float) -> bool:
    standing, moving = (scene.segments, scene.circles), scene.moving(time, time)
    ranges, _, _ = trace(sight[None], np.zeros(1), np.zeros(1), standing, moving, length)
    return bool(np.isinf(ranges[0]))


def walker(place: Array, time: float, heading: float) -> Person:
    """Return someone who comes by a place at a time."""
    walked = min(1.0, SPEED * time)  # less where the run has only just begun
    step = np.array([math.cos(heading), math.sin(heading)])
    (x0, y0), (x1, y1) = (place - walked * step).tolist(), (place + step).tolist()
    start = time - walked / SPEED if walked < SPEED * time else 0.0
    return Person(waypoints=((x0, y0), (x1, y1)), start=start, speed=SPEED)
