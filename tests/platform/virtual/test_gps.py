"""The virtual robot's receiver, from its port through the driver into a log."""

import sys
import time

import numpy as np
import pytest
from tests.platform.devices.inbox import Inbox

from impslam.columns import messages
from impslam.component import build
from impslam.platform.virtual.gps import ORIGIN
from impslam.platform.virtual.process import VirtualRobot
from impslam.sources.base import recognise
from impslam.sources.recording import McapWriter
from impslam.types import SatelliteFix

pytest.importorskip("serial")
pytest.importorskip("pynmeagps")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


def test_its_fixes_are_read_recorded_and_survive_an_unplugged_port(tmp_path):
    inbox = Inbox()
    with VirtualRobot("room", seed=2, camera=False, gps=True) as robot:
        receiver = build("device", {"retry": 0.05, **robot.devices()["gps"]}, "gps")
        receiver.start(inbox)
        try:
            inbox.wait(SatelliteFix, 3)
            truth = np.array(robot.truth()["pose"])
            robot.fault("unplug", device="gps", seconds=1.0)
            time.sleep(1.0)
            fixes = inbox.wait(SatelliteFix, len(inbox.of(SatelliteFix)) + 2)
        finally:
            receiver.stop()
    path = tmp_path / "a.mcap"
    with McapWriter(path, "imp") as writer:
        for reading in fixes:
            writer.write(reading.message)
    with recognise(path)(path=path) as source:
        back = list(messages(source.batches()))
    assert len(back) == len(fixes)
    for fix in back:
        assert isinstance(fix, SatelliteFix)
        off = (
            ORIGIN.points(*(np.array(v) for v in (fix.latitude, fix.longitude, 40.0)))[:2]
            - truth[:2]
        )
        assert off @ off / fix.covariance[0, 0] < 18.4  # chi-square of 2, 99.99 %
    assert receiver.health().counts["lost connection"] >= 1
