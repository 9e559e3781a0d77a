"""The simulated robot's camera: pictures at its rate, of the size and the field that were asked for."""

import math

import cv2
import numpy as np
import pytest

from impslam.cli.simulate import load_robot
from impslam.simulation.drive import drive
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Image, LaserScan

ALONE = ["encoders=none", "imu=none", "lidar=none", "truth_rate=1.0"]


def pictures(*settings):
    told = simulate(load_world("room"), load_robot(settings=[*ALONE, *settings]), 1)
    return (message for message in told if isinstance(message, Image))


def decoded(image):
    return cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)


def test_pictures_come_at_5_hz_and_change_as_it_drives():
    found = list(pictures("camera.rate=5"))
    stamps = np.array([image.stamp for image in found])
    np.testing.assert_allclose(np.diff(stamps), 0.2, atol=1e-9)
    assert stamps[-1] - stamps[0] == pytest.approx(
        drive(load_world("room").robot).duration, abs=0.2
    )
    first, last = decoded(found[0]), decoded(found[len(found) // 2])
    assert first.shape == (240, 640, 3)
    assert np.abs(first.astype(int) - last).mean() > 5.0


def test_5_mp_show_the_field_of_the_thesis():
    first = next(pictures("camera.rate=5", "camera.width=3648", "camera.height=1368"))
    image = decoded(first)
    assert image.shape[0] * image.shape[1] == pytest.approx(5e6, rel=0.002)
    focal = 0.5 * 3648 / math.tan(math.radians(36.0))
    assert 2.0 * math.degrees(math.atan(0.5 * 1368 / focal)) == pytest.approx(30.5, abs=0.2)
    small = decoded(next(pictures("camera.rate=5")))
    shrunk = cv2.resize(image, (640, 240), interpolation=cv2.INTER_AREA)
    assert np.abs(shrunk.astype(int) - small).mean() < 8.0  # the same view


def test_there_are_no_pictures_by_default():
    settings = ["encoders=none", "imu=none", "truth_rate=1.0"]
    told = list(simulate(load_world("room"), load_robot(settings=settings), 1))
    assert any(isinstance(message, LaserScan) for message in told)
    assert not any(isinstance(message, Image) for message in told)
