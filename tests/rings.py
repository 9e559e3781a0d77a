"""A drive through a corridor that leads back to where it began, and on: a loop that closes."""

import math

from impslam.config import load
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import parse_world

GRAPH = load("imp", ["estimator.kind=graph", "seed=1"])  # by wheels, which drift more than scans

_WAY = [(2, 0), (13, 0), (14, 1), (14, 9), (13, 10), (1, 10), (0, 9), (0, 1), (1, 0), (9, 0)]
_OUTER = [(-1.1, -1.0), (15.0, -1.0), (15.0, 11.2), (-1.1, 11.2)]
_INNER = [(1.0, 1.0), (1.0, 9.0), (13.1, 9.0), (13.1, 1.0)]
_BOXES = [(4.0, -0.85), (10.5, 0.8), (14.8, 4.0), (9.0, 11.0), (3.2, 9.2), (-0.9, 6.5)]


def _world():
    lines = ["[robot]", "start = [0.0, 0.0, 0.0]", "speed = 1.0", "turn_rate = 1.0"]
    lines += [f"waypoints = {[list(map(float, place)) for place in _WAY]}"]
    for ring in (_OUTER, _INNER):
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
            lines += ["[[walls]]", f"start = {list(a)}", f"end = {list(b)}"]
    for k, place in enumerate(_BOXES):
        size = [0.3 + 0.1 * k, 0.3]
        lines += ["[[boxes]]", f"centre = {list(place)}", f"size = {size}", f"angle = {0.3 * k}"]
    return parse_world("\n".join(lines), "ring")


def ring():
    """Yield the messages of a drive of 55 m, whose last 8 m repeat its first ones."""
    robot = SimulatedRobot(
        lidar=Lidar(range_max=10.0, rate=5.0, beams=341, angle_step=math.tau / 512),
        encoders=WheelEncoders(rate=20.0),
        imu=None,
        truth_rate=1.0,
    )
    yield from simulate(_world(), robot, seed=1)
