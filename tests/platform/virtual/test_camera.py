import http.client
import math
import time
from urllib.parse import urlparse

import cv2
import numpy as np
import pytest

from impslam.platform.virtual.camera import BOUNDARY, CameraEmulator
from impslam.simulation.camera import HEIGHT, Lens
from impslam.simulation.scene import Scene
from impslam.simulation.world import load_world, parse_world

ROOM = """
[robot]
waypoints = [[1.0, 0.0]]
[[walls]]
start = [4.15, -9.0]
end = [4.15, 9.0]
"""
CONE = """
[[cylinders]]
centre = [2.15, 0.0]
radius = 0.2
"""


def camera(text=ROOM, pose=(0.0, 0.0, 0.0), **options):
    return CameraEmulator(Scene(parse_world(text, "room")), lambda: np.array(pose), **options)


def column(picture, where):
    return picture[:, where].astype(int)


def test_a_wall_has_the_rows_of_a_pinhole_camera():
    lens = Lens()
    depth = 4.0  # from the camera, which is 0.15 m before base_link
    middle = 0.5 * (lens.height - 1)
    top = middle - (HEIGHT - lens.above_floor) * lens.focal / depth
    bottom = middle + lens.above_floor * lens.focal / depth
    picture = camera().picture()
    for side in (10, 320, 630):  # at an equal depth a wall is equally high in all columns
        strip = column(picture, side)
        changes = np.flatnonzero(np.abs(np.diff(strip.sum(1))) > 25)
        assert abs(changes - top).min() <= 1
        assert abs(changes - bottom).min() <= 1


def test_a_cone_hides_the_wall_and_is_where_it_is_wide():
    lens = Lens()
    with_, without = camera(ROOM + CONE).picture(), camera().picture()
    differ = np.flatnonzero((with_ != without).any(axis=(0, 2)))
    half = lens.focal * math.tan(math.asin(0.2 / 2.0))
    middle = 0.5 * (lens.width - 1)
    assert differ[0] == pytest.approx(middle - half, abs=1)
    assert differ[-1] == pytest.approx(middle + half, abs=1)
    blue, green, red = with_[lens.height // 2, lens.width // 2]
    assert red > 2 * blue
    assert red > green  # orange


def test_left_is_left():
    left = ROOM + CONE.replace("0.0]", "1.0]")
    differ = (camera(left).picture() != camera().picture()).any(axis=(0, 2))
    assert np.flatnonzero(differ).max() < Lens().width // 2


def _orange(picture):
    row = picture[120].astype(int)
    return row[:, 2] > 2 * row[:, 0] + 20


def test_turning_by_the_angle_of_columns_shifts_the_picture():
    # On the optical axis only: elsewhere a turn is a homography.
    lens = Lens()
    cone = camera(ROOM + CONE).picture()
    turn = math.atan(100 / lens.focal)
    turned = camera(ROOM + CONE, (0.15 - 0.15 * math.cos(turn), -0.15 * math.sin(turn), turn))
    centre = np.flatnonzero(_orange(cone)).mean()
    assert np.flatnonzero(_orange(turned.picture())).mean() - centre == pytest.approx(100, abs=3)


def test_an_empty_view_is_not_an_error():
    empty = "[robot]\nwaypoints = [[1.0, 0.0]]\n"
    assert camera(empty).picture().shape == (240, 640, 3)


@pytest.mark.parametrize("world", ["arena", "corridor", "room"])
def test_every_shipped_world_from_everywhere(world, rng):
    scene = Scene(load_world(world))
    for pose in rng.uniform(-8, 8, (10, 3)):
        eye = CameraEmulator(scene, lambda pose=pose: pose, lambda: 7.0)
        assert eye.picture().any()


def test_stream_is_read_by_a_plain_client():
    eye = camera(rate=50.0)
    url = urlparse(eye.serve())
    try:
        assert url.hostname == "127.0.0.1"
        link = http.client.HTTPConnection(url.hostname, url.port, timeout=5)
        link.request("GET", url.path)
        answer = link.getresponse()
        assert BOUNDARY in answer.headers["Content-Type"]
        for _ in range(3):
            assert answer.readline().strip() == f"--{BOUNDARY}".encode()
            answer.readline()
            size = int(answer.readline().split(b":")[1])
            answer.readline()
            picture = cv2.imdecode(np.frombuffer(answer.read(size), np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == (240, 640, 3)
            answer.readline()
        link.close()
    finally:
        eye.close()


def test_unplugged_it_refuses_and_comes_back():
    eye = camera(rate=50.0)
    url = urlparse(eye.serve())

    def status(path=url.path):
        link = http.client.HTTPConnection(url.hostname, url.port, timeout=5)
        link.request("GET", path)
        found = link.getresponse().status
        link.close()
        return found

    try:
        assert status("/other") == 404
        assert status() == 200
        eye.unplug(0.3)
        assert status() == 503
        time.sleep(0.31)
        assert status() == 200
    finally:
        eye.close()
    with pytest.raises(OSError, match=r"refused|reset"):
        status()
