"""The truth of a virtual robot, recorded and shown as if a tracking system measured it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from impslam.errors import ImpError, in_a_line
from impslam.platform.devices.base import Reading, now
from impslam.types import TruePose

log = logging.getLogger(__name__)

PERIOD = 0.1
"""s between two poses: at 0.5 m/s the way between is 5 cm, and nearly straight."""


class TruthFollower:
    """Asks in a thread of its own where the robot is, and passes that on.

    Parameters
    ----------
    truth : returns "pose" (3,) in the world and "monotonic", the time of it in s; see `VirtualImp.truth`
    put : takes the poses
    """

    def __init__(
        self, truth: Callable[[], Mapping[str, Any]], put: Callable[[Reading], None]
    ) -> None:
        self._truth, self._put = truth, put
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="truth", daemon=True)

    def start(self) -> None:
        """Begin to follow."""
        self._thread.start()

    def stop(self) -> None:
        """Follow no more."""
        self._over.set()
        self._thread.join()

    def _follow(self) -> None:
        while not self._over.wait(PERIOD):
            try:
                told = self._truth()
            except ImpError as error:  # the virtual robot has ended
                log.warning("its truth is recorded no more: %s", in_a_line(error))
                return
            arrived = now()
            stamp = arrived - (time.monotonic() - told["monotonic"])
            pose = TruePose(stamp, np.array(told["pose"], np.float64))
            self._put(Reading(pose, arrived, "truth"))
