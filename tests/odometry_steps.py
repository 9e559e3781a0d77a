"""Odometry by the message, and messages as columns."""

from collections.abc import Iterable

import numpy as np

from impslam.columns import Columns, batches, single_row
from impslam.errors import MessageError
from impslam.odometry.base import Odometry
from impslam.odometry.stream import OdometryStream
from impslam.types import Increment, Message


def stacked(messages: Iterable[Message]) -> Columns:
    """Return messages of one type and layout as the rows of a stream."""
    ((_, columns),) = next(iter(batches((("", m) for m in messages), 10**9))).items()
    return columns


class StepwiseOdometry:
    """An odometry that gets its messages in batches of one row."""

    def __init__(self, odometry: Odometry) -> None:
        self.consumes, self.stream = odometry.consumes, OdometryStream(odometry)

    def update(self, message: Message) -> Increment | None:
        """Return the motion since the message before, None if none is known; raise what is wrong."""
        (row,) = single_row("", message, 0).values()
        motions, faults, example = self.stream.motions(row)
        if faults.any():
            raise MessageError(example)
        assert example == ""
        return motions.row(0) if np.isfinite(motions.d_pose).all() else None
