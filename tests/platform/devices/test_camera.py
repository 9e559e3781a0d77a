import time

import cv2
import numpy as np
import pytest
from tests.platform.devices.inbox import PATIENCE, Inbox

from impslam.component import build
from impslam.platform.devices.base import now
from impslam.platform.devices.camera import Camera
from impslam.platform.virtual.camera import CameraEmulator
from impslam.simulation.scene import Scene
from impslam.simulation.world import load_world
from impslam.types import Event, Image


@pytest.fixture
def eye():
    emulator = CameraEmulator(
        Scene(load_world("arena")), lambda: np.array([0.0, 0.0, 1.57]), rate=20.0
    )
    emulator.url = emulator.serve()
    yield emulator
    emulator.close()


@pytest.fixture
def served(eye):
    camera, inbox = Camera(source=eye.url, retry=0.05), Inbox()
    camera.start(inbox)
    yield camera, inbox
    camera.stop()


def test_pictures_come_at_their_rate_decode_and_are_fresh(served):
    camera, inbox = served
    begin = now()
    first = inbox.wait(Image, 8)[:8]
    stamps = np.array([r.message.stamp for r in first])
    assert np.median(np.diff(stamps)) == pytest.approx(0.2, abs=0.06)  # 5 of the 20 Hz
    assert begin - 2.0 < stamps[0] <= now()
    for reading in first:
        assert reading.arrived >= reading.message.stamp
        assert reading.message.format == "jpeg"
        picture = cv2.imdecode(np.frombuffer(reading.message.data, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (240, 640, 3)
    assert camera.health().state == "ok"
    assert "640 x 240" in camera.health().detail


def test_an_unplugged_camera_is_notified_and_reopened(served, eye):
    camera, inbox = served
    before = len(inbox.wait(Image, 1))
    eye.unplug(0.3)
    inbox.wait(Image, before + 3)
    events = [r.message for r in inbox.of(Event) if r.message.level == "error"]
    # Cut and refused are two reasons; or one, if the cut is seen only when it is back.
    assert 1 <= len(events) <= 2
    assert all(eye.url in event.text for event in events)
    assert camera.health().counts["lost connection"] >= 1


def test_a_camera_that_hangs_does_not_delay_the_stop(served, eye):
    camera, inbox = served
    inbox.wait(Image, 1)
    eye.freeze(PATIENCE)
    time.sleep(0.2)
    begin = time.monotonic()
    camera.stop()
    assert time.monotonic() - begin < 2.5
    assert camera.health().state == "stopped"


@pytest.mark.parametrize(
    ("source", "advice"),
    [
        ("/dev/video-that-is-not", "plug it in"),
        ("97", "plug it in"),
        ("http://127.0.0.1:9/stream", "check the address"),
        ("/dev/null", "another program"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_notified_once(source, advice, capfd):
    camera, inbox = Camera(source=source, retry=0.02), Inbox()
    camera.start(inbox)
    inbox.wait(Event, 1)
    time.sleep(0.2)
    camera.stop()
    events = inbox.of(Event)
    assert len(events) == 1
    assert source in events[0].message.text
    assert advice in events[0].message.text
    assert capfd.readouterr().err == ""


def test_it_is_registered_by_its_name():
    assert build("device", {"kind": "camera", "source": "0", "rate": 2}).rate == 2
