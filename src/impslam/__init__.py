"""impslam: SLAM for small wheeled robots with a 2D lidar.

`impslam.run` takes a log and returns a map, e.g. `impslam.run("log.mcap", "turtlebot3-waffle")`.
`impslam.Slam` takes arrays from your own program:

>>> import numpy as np
>>> import impslam
>>> angles = np.radians(np.arange(-180, 180))
>>> ranges = 2.0 / np.maximum(abs(np.cos(angles)), abs(np.sin(angles)))  # a room of 4 by 4 m
>>> slam = impslam.Slam("default")
>>> for stamp in range(10):
...     slam.add_odometry(stamp, [0.0, 0.0, 0.0])
...     slam.add_scans(stamp, ranges, angles)
>>> known = slam.finish()
>>> known.path().shape
(10, 4)
>>> known.grid().resolution
0.05

Both return an `impslam.Map`: `path()`, `landmarks`, `grid()`, `save()` and `Map.load()`.
`impslam.Relocaliser` finds a scan anywhere in a map.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from impslam.errors import ImpError
    from impslam.map import Map
    from impslam.recognition.relocalisation import Relocaliser
    from impslam.run import run
    from impslam.slam import Slam

__all__ = ["ImpError", "Map", "Relocaliser", "Slam", "run"]

_MODULES = {
    "ImpError": "errors",
    "Map": "map",
    "Relocaliser": "recognition.relocalisation",
    "Slam": "slam",
    "run": "run",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first access: the command line needs few of them."""
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415  25 ms that no command needs

        return version("impslam")
    if name not in _MODULES:
        raise AttributeError(f"module 'impslam' has no attribute {name!r}")
    module = importlib.import_module(f"impslam.{_MODULES[name]}")
    # `impslam.run` is this module, which can be called like the function in it.
    return module if name == "run" else getattr(module, name)
