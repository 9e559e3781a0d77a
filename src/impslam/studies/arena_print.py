"""What the thesis prints of its controlled experiments (Tables 1 to 3), and what that means.

The column "Error (m)" of the tables is the squared distance between the two positions of its row, to
the last digit; here distances are computed from the positions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from impslam.geometry.angles import wrap
from impslam.types import Array, TrueLandmark

END = "end position"

DETECTED: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "points": {
        "cylinder 1": (-1.2525, 1.4851),
        "cylinder 2": (-0.7522, 3.3942),
        "cylinder 3": (-1.5308, 5.2055),
        END: (-0.5917, 2.4141),
    },
    "lines": {
        "wall 1": (-0.0066, -0.4371),
        "wall 2": (0.3018, -0.0018),
        "wall 3": (-0.1784, 6.3731),
        "wall 4": (-1.7358, -0.0447),
        END: (-0.5362, 2.3477),
    },
    "both": {
        "cylinder 1": (-1.2856, 1.5376),
        "cylinder 2": (-0.5768, 3.3911),
        "cylinder 3": (-1.1308, 5.2717),
        "wall 1": (-0.0177, -0.3476),
        "wall 2": (0.2805, -0.0080),
        "wall 3": (-0.3663, 6.1225),
        "wall 4": (-1.7436, 0.0152),
        END: (-0.5013, 2.4103),
    },
}
"""Tables 1, 2 and 3: detected positions of centres and of feet of normals, m, in map."""


def turned(detected: tuple[float, float], actual: Array) -> float:
    """Return by which angle (rad) the print is turned about the start, counter-clockwise."""
    return float(wrap(math.atan2(detected[1], detected[0]) - math.atan2(actual[1], actual[0])))


def too_far(detected: tuple[float, float], actual: Array) -> float:
    """Return how much too far from the start the print is, m."""
    return math.hypot(*detected) - math.hypot(*actual)


def off_middle(detected: tuple[float, float], wall: TrueLandmark) -> float:
    """Return how far the printed wall is from the middle of the true one, m."""
    assert wall.end_points is not None
    r = math.hypot(*detected)
    return float(abs(np.dot(detected, wall.end_points.mean(axis=0)) / r - r))
