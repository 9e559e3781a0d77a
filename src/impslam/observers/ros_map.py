"""Writes the result of a run as an MCAP file for Foxglove and RViz."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from impslam.geometry.se2 import compose, inverse
from impslam.map import Map
from impslam.maps.files import map_image
from impslam.observers import ros_markers, ros_values
from impslam.observers.base import Observer, Outcome, require_placed
from impslam.observers.history import health_of, rows_of_log
from impslam.sources.mcap_file import LATCHED, McapFile
from impslam.sources.ros_build import message_types, nanoseconds
from impslam.sources.ros_storage import RosMessage
from impslam.sources.ros_writers import Record
from impslam.types import Array, Ints


class RosMap(Observer):
    """Writes the file at the end of a run: see `write_ros_map`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Write the file."""
        write_ros_map(self._path, known, outcome)


def write_ros_map(path: Path, known: Map, outcome: Outcome) -> None:
    """Write a map as an MCAP file, replacing an existing one.

    The final `/map`, `/path` and `/landmarks` come first and are latched. `/tf` (map -> odom -> base_link)
    and `/health` follow, a message for each scan of the log, in order of the stamps; of scans with equal
    stamps only the last one is written. If the map was continued, other logs are of other times.

    Raises
    ------
    ImpError
        If the file cannot be written, or ROS cannot represent the stamps.
    """
    require_placed(path, known)
    rows, drive = known.rows(), rows_of_log(known, outcome.health)
    at = (drive.start + _chronological(rows.stamps[drive])).tolist()
    stamps, poses, odometry = rows.stamps[at], rows.poses[at], rows.odometry[at]
    health = health_of(known, outcome.health)
    reasons, amounts = health.reasons, health.amounts
    begin = float(stamps[0] if len(stamps) else rows.stamps.max())  # no scan of the log is located
    with McapFile(path) as file:

        def write(topic: str, stamp: float, message: RosMessage, latched: bool = False) -> None:
            kind = message.__msgtype__
            record = Record(topic, kind, message_types().serialize_cdr(message, kind))
            file.append(record, nanoseconds(stamp), *(LATCHED,) * latched)

        image = map_image(known.grid(outcome.config["grid"]["resolution"]))
        write("/map", begin, ros_values.grid(image, begin), True)
        write("/path", begin, ros_values.path(rows.stamps, rows.poses), True)
        write("/landmarks", begin, ros_markers.landmarks(known.landmarks, begin), True)
        T_map_odom = compose(poses, inverse(odometry))
        for k, stamp in enumerate(stamps.tolist()):
            write("/tf", stamp, ros_values.frames(stamp, T_map_odom[k], odometry[k]))
            reason, amount = int(reasons[at[k]]), float(amounts[at[k]])
            write("/health", stamp, ros_values.health(stamp, reason, amount))


def _chronological(stamps: Array) -> Ints:
    """Return the rows in order of the stamps (n,), only the last of equal ones, as tf2 requires."""
    order = np.argsort(stamps, kind="stable")
    last = np.diff(stamps[order], append=np.inf) > 0.0
    return np.asarray(order[last])
