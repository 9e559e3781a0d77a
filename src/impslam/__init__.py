"""impslam: SLAM for small wheeled robots with a 2D lidar.

import impslam

known = impslam.run("log.mcap", "turtlebot3-waffle")   # a log in, a map out
known.path(); known.landmarks; known.grid(); known.save("office.imp")

slam = impslam.Slam("default")                         # or arrays of a program of your own
slam.add_odometry(stamps, poses)
slam.add_scans(stamps, ranges, angles)
slam.map()
"""

from __future__ import annotations

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from impslam.errors import ImpError
    from impslam.map import Map
    from impslam.run import run
    from impslam.slam import Slam

__all__ = ["ImpError", "Map", "Slam", "run"]

_PLACES = {"ImpError": "errors", "Map": "map", "Slam": "slam", "run": "run"}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: the command line needs little of it."""
    if name == "__version__":
        return version("impslam")
    if name not in _PLACES:
        raise AttributeError(f"module 'impslam' has no attribute {name!r}")
    module = importlib.import_module(f"impslam.{_PLACES[name]}")
    # `impslam.run` is the module of this name, which can be called as the function in it.
    return module if name == "run" else getattr(module, name)
