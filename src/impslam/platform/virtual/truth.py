"""The true poses of a virtual robot, recorded and shown as if measured by a tracking system."""

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
"""s between poses: at 0.5 m/s the path between them is 5 cm long, and nearly straight."""


class TruthFollower:
    """Polls the true pose in its own thread and forwards it.

    Parameters
    ----------
    truth : returns "pose" (3,) in the world and "monotonic", its time, s; see `VirtualImp.truth`
    put : called with each pose
    """

    def __init__(
        self, truth: Callable[[], Mapping[str, Any]], put: Callable[[Reading], None]
    ) -> None:
        self._truth, self._put = truth, put
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="truth", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join()

    def _poll(self) -> None:
        while not self._stopping.wait(PERIOD):
            try:
                truth = self._truth()
            except ImpError as error:  # the virtual robot has ended
                log.warning("the true path is no longer recorded: %s", in_a_line(error))
                return
            arrived = now()
            stamp = arrived - (time.monotonic() - truth["monotonic"])
            pose = TruePose(stamp, np.array(truth["pose"], np.float64))
            self._put(Reading(pose, arrived, "truth"))
