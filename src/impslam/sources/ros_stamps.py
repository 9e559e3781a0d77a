"""The stamps of ROS messages: those of their headers, or log times if headers have none."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path

from rosbags.interfaces import Connection

from impslam.sources.base import Problems
from impslam.sources.ros_messages import NANOSECONDS, header_stamp
from impslam.sources.ros_storage import Bag, RosMessage
from impslam.sources.ros_topics import TF_TYPES, Use


class HeaderStamps:
    """Returns the stamps of the messages of a log.

    Parameters
    ----------
    path : the log, for reports of problems
    bag : the open log
    uses : what the messages of each topic are used for
    problems : collects problems with messages
    """

    def __init__(self, path: Path, bag: Bag, uses: Mapping[str, Use], problems: Problems) -> None:
        self._path, self._bag, self._uses, self._problems = path, bag, uses, problems
        self._starts_at_zero = any(map(self._has_zero_start, bag.connections))

    def of(self, message: RosMessage, topic: str, log_time: int) -> int:
        """Return the stamp of a message in ns, or its log time if it has none."""
        nanoseconds = header_stamp(message)
        if nanoseconds or self._starts_at_zero or log_time <= NANOSECONDS:
            return nanoseconds
        self._problems.add(
            "no stamp",
            f"{self._path}: {topic} has headers without a stamp; the log time is used",
        )
        return log_time

    def _has_zero_start(self, connection: Connection) -> bool:
        """Return whether stamps start at 0: there is a clock, or only the first stamp is 0."""
        if connection.topic == "/clock":
            return connection.msgcount > 0
        if self._uses.get(connection.topic) not in ("scan", "odometry"):
            return False
        found = []
        with suppress(Exception):  # rosbags may raise anything on damaged data
            for _, _, data in islice(self._bag.messages([connection]), 2):
                message = self._bag.decoder(connection)(data)
                if connection.msgtype in TF_TYPES:
                    message = message.transforms[0]
                found.append(header_stamp(message))
        return len(found) == 2 and found[0] == 0 < found[1]
