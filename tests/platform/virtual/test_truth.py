"""Recordings of a virtual robot contain its true poses."""

import threading
import time

import numpy as np
import pytest
from tests.waiting import wait_until

from impslam.errors import ImpError
from impslam.platform.devices.base import now
from impslam.platform.virtual import truth
from impslam.platform.virtual.truth import TruthFollower
from impslam.types import TruePose


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(truth, "PERIOD", 0.002)


def test_poses_are_stamped_with_their_time():
    seen, enough = [], threading.Event()

    def put(reading):
        seen.append(reading)
        if len(seen) == 3:
            enough.set()

    reported = {"pose": [1.0, 2.0, 0.5], "monotonic": time.monotonic() - 7.0}
    before = now() - 7.0
    follower = TruthFollower(lambda: reported, put)
    follower.start()
    assert enough.wait(5.0)
    follower.stop()
    count = len(seen)
    time.sleep(0.02)
    assert len(seen) == count
    assert isinstance(seen[0].message, TruePose)
    np.testing.assert_array_equal(seen[0].message.pose, reported["pose"])
    assert seen[0].message.stamp == pytest.approx(before, abs=0.05)
    assert seen[0].arrived > seen[0].message.stamp + 6.9


def test_it_ends_with_the_virtual_robot(caplog):
    def gone():
        raise ImpError("the virtual robot has ended")

    follower = TruthFollower(gone, pytest.fail)
    follower.start()
    wait_until(lambda: "no longer recorded: the virtual robot has ended" in caplog.text)
    follower.stop()
