"""Random buildings with similar places: twin corridors, with rooms of a few kinds along them.

A third of the rooms is unique; all others have one or more twins. The simulated lidar has 360 beams over
270 degrees, 1 cm of noise, and a range of 20 m.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from impslam.map import Keyframes
from impslam.recognition.stored_views import points_view
from impslam.recognition.submap import View
from impslam.simulation.raycast import trace
from impslam.types import Array

BEAMS, FIELD, MAX_RANGE, NOISE = 360, np.radians(270.0), 20.0, 0.01
CORRIDOR_WIDTH, DOOR_WIDTH = 2.0, 1.0  # m
KINDS, UNIQUE_SHARE = 3, 1.0 / 3.0  # kinds of rooms, and the share of unique rooms
DRIVE_SCANS, DRIVE_STEP = 6, 0.4  # of a drive of 2 m, and m between them
CLEARANCE = 0.4  # m between a robot and walls or furniture
ANGLES = (np.arange(BEAMS) + 0.5) / BEAMS * FIELD - 0.5 * FIELD


class Building(NamedTuple):
    """Walls and furniture as segments (s, 4), and free boxes (b, 4) from low to high x and y."""

    walls: Array
    floors: Array

    def scan(self, pose: Array, rng: np.random.Generator) -> Array:
        """Return the end points (n, 2) of the beams that hit anything, in base_link."""
        lasers, none = np.tile(pose, (BEAMS, 1)), (np.empty((2, 0, 4)), np.empty((2, 0, 3)))
        standing = self.walls, np.empty((0, 3))
        ranges, _, hit = trace(lasers, ANGLES, np.zeros(BEAMS), standing, none, MAX_RANGE)
        ranges = ranges[hit >= 0] + NOISE * rng.standard_normal(np.count_nonzero(hit >= 0))
        angles = ANGLES[hit >= 0]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def view(self, pose: Array, rng: np.random.Generator) -> View:
        return points_view(self.scan(pose, rng), np.zeros(2))

    def clear(self, poses: Array, metres: float = CLEARANCE) -> Array:
        """Return the poses (k, 3) with enough clearance from all walls."""
        a, b = self.walls[:, :2], self.walls[:, 2:]
        along = b - a
        to = poses[:, None, :2] - a
        share = np.clip((to * along).sum(2) / (along**2).sum(1), 0.0, 1.0)
        apart = np.linalg.norm(to - share[..., None] * along, axis=2)
        return poses[apart.min(1) > metres]

    def places(self, rng: np.random.Generator, count: int) -> Array:
        """Return random poses (count, 3), uniform over the floors."""
        sizes = (self.floors[:, 2:] - self.floors[:, :2]).prod(1)
        found = np.empty((0, 3))
        while len(found) < count:
            floors = self.floors[rng.choice(len(sizes), count, p=sizes / sizes.sum())]
            xy = floors[:, :2] + rng.random((count, 2)) * (floors[:, 2:] - floors[:, :2])
            turned = np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])
            found = np.concatenate([found, self.clear(turned)])
        return found[:count]

    def drives(self, rng: np.random.Generator, count: int, above: float) -> Array:
        """Return straight drives (count, DRIVE_SCANS, 3) that end at y > `above` m, at random places."""
        back = DRIVE_STEP * np.arange(DRIVE_SCANS)[::-1, None]
        found: list[Array] = []
        while len(found) < count:
            for end in self.places(rng, count):
                way = np.tile(end, (DRIVE_SCANS, 1))
                way[:, :2] -= back * np.array([np.cos(end[2]), np.sin(end[2])])
                if end[1] > above and len(self.clear(way)) == DRIVE_SCANS:
                    found.append(way)
        return np.array(found[:count])

    def map(self, rng: np.random.Generator) -> Keyframes:
        """Return keyframes at true poses, about a metre apart, two of opposite heading at each."""
        spots = []
        for x0, y0, x1, y1 in self.floors:
            x, y = np.arange(x0 + 0.5, x1, 1.0), np.arange(y0 + 0.5, y1, 1.0)
            spots.append(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        xy = np.concatenate(spots)
        heading = rng.uniform(-np.pi, np.pi, len(xy))
        poses = np.concatenate([
            np.column_stack([xy, heading]), np.column_stack([xy, heading + np.pi])
        ])  # fmt: skip
        poses = self.clear(poses)
        return keyframes([self.scan(pose, rng) for pose in poses], poses)


def keyframes(scans: list[Array], poses: Array) -> Keyframes:
    """Return keyframes of scans (n, 2) m at poses (k, 3)."""
    k = len(poses)
    return Keyframes(
        stamps=np.arange(k, dtype=float),
        poses=poses,
        covariances=np.tile(1e-4 * np.eye(3), (k, 1, 1)),
        innovations=np.zeros((k, 3)),
        origins=np.zeros((k, 2)),
        starts=np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]),
        points=np.concatenate(scans).astype(np.float32),
        motions=np.zeros((k, 3)),
        motion_covariances=np.zeros((k, 3, 3)),
        sessions=np.zeros(k, np.int64),
        placed=np.ones(k, np.bool_),
    )


def buildings(seed: int) -> Iterator[Building]:
    """Yield buildings endlessly: two corridors, one above the other, joined at their left ends."""
    rng = np.random.default_rng(seed)
    while True:
        wide, deep, count = rng.uniform(3.0, 5.0), rng.uniform(3.5, 5.5), int(rng.integers(4, 8))
        kinds = [_furniture(rng, wide, deep) for _ in range(KINDS)]
        length, high = count * wide, 2.0 * deep + CORRIDOR_WIDTH
        walls = [
            _box(-CORRIDOR_WIDTH, 0.0, length, 2.0 * high),
            np.array([[0.0, high, length, high]]),
        ]
        floors = [[-CORRIDOR_WIDTH, 0.0, 0.0, 2.0 * high]]
        for low, middle, top in (
            (0.0, deep, deep + CORRIDOR_WIDTH),
            (high, high + deep, high + deep + CORRIDOR_WIDTH),
        ):
            floors.append([0.0, middle, length, top])
            walls.append(np.array([[0.0, low, 0.0, middle], [0.0, top, 0.0, low + high]]))
            for left in wide * np.arange(count):
                for outer, inner in ((low, middle), (low + high, top)):
                    own = _furniture(rng, wide, deep)
                    inside = own if rng.random() < UNIQUE_SHARE else kinds[rng.integers(KINDS)]
                    walls += [_room(left, inner, outer, wide)]
                    walls += [_placed(inside, left, outer, wide, turned=outer > inner)]
                    floors.append([left, min(outer, inner), left + wide, max(outer, inner)])
        yield Building(np.ascontiguousarray(np.concatenate(walls)), np.array(floors))


def _furniture(rng: np.random.Generator, wide: float, deep: float) -> Array:
    """Return two boxes in a room (8, 4), from its corner at the outer wall."""
    size = rng.uniform(0.4, 0.8, (2, 2))  # too small for a robot to stand inside
    at = rng.random((2, 2)) * (np.array([wide, deep - 1.0]) - size)
    return np.concatenate([_box(*a, *(a + s)) for a, s in zip(at, size, strict=True)])


def _room(left: float, wall: float, base: float, wide: float) -> Array:
    """Return the wall to the corridor with a door, and the wall to the next room."""
    door, right = left + 0.5 * (wide - DOOR_WIDTH), left + wide
    return np.array([
        [left, wall, door, wall], [door + DOOR_WIDTH, wall, right, wall], [right, wall, right, base]
    ])  # fmt: skip


def _placed(furniture: Array, left: float, outer: float, wide: float, *, turned: bool) -> Array:
    """Return furniture in its room, turned by 180 degrees if the outer wall is the upper one."""
    if turned:
        return np.array([left + wide, outer, left + wide, outer]) - furniture
    return furniture + np.array([left, outer, left, outer])


def _box(x0: float, y0: float, x1: float, y1: float) -> Array:
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return np.hstack([corners, np.roll(corners, -1, axis=0)])
