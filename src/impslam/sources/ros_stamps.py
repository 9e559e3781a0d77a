"""The stamps of ROS messages: those of their headers, or from log times if headers have none."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path

from rosbags.interfaces import Connection

from impslam.sources.base import Problems
from impslam.sources.ros_frames import Edge
from impslam.sources.ros_messages import NANOSECONDS, header_stamp, seconds
from impslam.sources.ros_storage import Bag, RosMessage
from impslam.sources.ros_topics import TF_TYPES, Use

FIRST_MESSAGES = 20
"""Messages at the beginning of a topic that show how long after its stamp a message is logged."""
MIN_WALL_TIME = 10**9 * NANOSECONDS
"""ns, September 2001: simulators and clocks since the start of a device show less."""


class HeaderStamps:
    """Returns the stamps of the messages of a log.

    Parameters
    ----------
    path : the log, for reports of problems
    bag : the open log
    uses : what the messages of each topic are used for
    odometry : the transform that is odometry, if any
    problems : collects problems with messages
    """

    def __init__(
        self,
        path: Path,
        bag: Bag,
        uses: Mapping[str, Use],
        odometry: Edge | None,
        problems: Problems,
    ) -> None:
        self._path, self._bag, self._odometry, self._problems = path, bag, odometry, problems
        first: dict[str, list[tuple[int, int]]] = {}
        for connection in bag.connections:
            if uses.get(connection.topic) in ("scan", "odometry"):
                first.setdefault(connection.topic, []).extend(self._first_stamps(connection))
        has_clock = any(c.topic == "/clock" and c.msgcount for c in bag.connections)
        self._starts_at_zero = has_clock or any(map(_starts_at_zero, first.values()))
        self._delays = {topic: _delay(stamps) for topic, stamps in first.items()}

    def of(self, message: RosMessage, topic: str, log_time: int) -> int:
        """Return the stamp of a message in ns; without one, its log time less the delay of others."""
        nanoseconds = header_stamp(message)
        if nanoseconds or self._starts_at_zero or log_time <= NANOSECONDS:
            return nanoseconds
        delay = self._delays.get(topic, 0)
        less = f" less {seconds(delay):.3f} s, the delay of other messages," if delay else ""
        self._problems.add(
            "no stamp",
            f"{self._path}: {topic} has headers without a stamp; the log time{less} is used",
        )
        return log_time - delay

    def _first_stamps(self, connection: Connection) -> list[tuple[int, int]]:
        """Return the stamp and the log time, ns, of the first messages of a topic."""
        found = []
        with suppress(Exception):  # rosbags may raise anything on damaged data
            for _, log_time, data in islice(self._bag.messages([connection]), FIRST_MESSAGES):
                message = self._bag.decoder(connection)(data)
                if connection.msgtype in TF_TYPES:
                    message = self._odometry.pick(message) if self._odometry else None
                if message is not None:
                    found.append((header_stamp(message), log_time))
        return found


def _starts_at_zero(first: list[tuple[int, int]]) -> bool:
    """Return whether the first stamp is 0 on a clock that starts at 0."""
    stamps = [stamp for stamp, _ in first[:2]]
    return len(stamps) == 2 and stamps[0] == 0 < stamps[1] < MIN_WALL_TIME


def _delay(first: list[tuple[int, int]]) -> int:
    """Return the median time from stamp to log, ns; 0 if no message has a stamp."""
    delays = [log_time - stamp for stamp, log_time in first if stamp]
    return statistics.median_low(delays) if delays else 0
