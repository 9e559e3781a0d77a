"""A building to simulate: rooms on both sides of a closed loop of corridors."""

from __future__ import annotations

from itertools import pairwise

from impslam.simulation.world import World

_OUTER = [(0.0, 0.0), (22.0, 0.0), (22.0, 15.0), (0.0, 15.0), (0.0, 0.0)]
_CORE = [(6.0, 5.5), (6.0, 9.5), (16.0, 9.5), (16.0, 5.5), (6.0, 5.5)]
_ROOMS = [  # the walls between rooms and the corridor, with their doors left open, and between rooms
    [(4.0, 3.5), (5.5, 3.5)], [(6.5, 3.5), (10.0, 3.5)], [(11.0, 3.5), (15.0, 3.5)],
    [(16.0, 3.5), (18.0, 3.5)], [(4.0, 3.5), (4.0, 7.0)], [(4.0, 8.0), (4.0, 11.5)],
    [(4.0, 11.5), (8.0, 11.5)], [(9.0, 11.5), (13.0, 11.5)], [(14.0, 11.5), (18.0, 11.5)],
    [(18.0, 3.5), (18.0, 6.0)], [(18.0, 7.0), (18.0, 11.5)],
    [(8.3, 0.0), (8.3, 3.5)], [(13.1, 0.0), (13.1, 3.5)], [(0.0, 5.2), (4.0, 5.2)],
    [(0.0, 10.4), (4.0, 10.4)], [(10.9, 11.5), (10.9, 15.0)], [(16.2, 11.5), (16.2, 15.0)],
    [(18.0, 8.6), (22.0, 8.6)],
]  # fmt: skip
_BOXES = [
    ((5.0, 3.7), (0.5, 0.4)), ((12.2, 5.3), (0.9, 0.4)), ((17.8, 9.4), (0.4, 1.0)),
    ((9.9, 9.7), (0.6, 0.4)), ((5.8, 8.8), (0.4, 0.8)), ((6.1, 0.6), (1.2, 0.7)),
    ((10.4, 1.0), (0.8, 1.4)), ((1.0, 7.9), (0.8, 1.6)), ((12.6, 14.2), (1.4, 0.8)),
]  # fmt: skip
_LAP = [
    (5.0, 4.5), (10.5, 4.5), (10.5, 2.4), (10.5, 4.5), (17.0, 4.5), (17.0, 10.5), (13.5, 10.5),
    (13.5, 13.0), (13.5, 10.5), (5.0, 10.5), (5.0, 7.5), (2.4, 7.5), (5.0, 7.5),
]  # fmt: skip

BUILDING = World(
    name="building",
    robot={
        "start": (5.0, 5.5, -1.57), "speed": 0.6, "turn_rate": 0.9, "lookahead": 0.35,
        "waypoints": [*_LAP, *_LAP],
    },
    walls=[{"start": a, "end": b} for line in [_OUTER, _CORE, *_ROOMS] for a, b in pairwise(line)],
    boxes=[{"centre": centre, "size": size} for centre, size in _BOXES],
)  # fmt: skip
