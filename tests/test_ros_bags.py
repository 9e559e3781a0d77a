"""Bags as users of slam_toolbox have them, each mapped by `imp run BAG` alone."""

import math
import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from tests.sources.ros_robots import URDF, Laser, Recipe, drive, write

import impslam
from impslam.fitting import choices
from impslam.geometry.se2 import between
from impslam.open_log import open_log
from impslam.simulation.robot import Lidar
from impslam.simulation.world import load_world

BACKWARD = (
    URDF[0],
    ("base_link", "mast", [0, 0, 0.2], [0, 0, math.pi]),
    ("mast", "laser", [-0.1, 0, 0.1], [0, 0, 0]),
)
DOWN = (URDF[0], ("base_link", "laser", [0.1, 0.05, 0.2], [math.pi, 0, 0.3]))
TWO = (
    URDF[0],
    ("base_link", "front", [0.15, 0, 0.1], [0, 0, 0]),
    ("base_link", "rear", [-0.15, 0, 0.1], [0, 0, math.pi]),
)
URG = Lidar(mount=(0.1, 0.05, 0.0))
CLOCKWISE = {"angle_min": -URG.angle_min, "angle_step": -URG.angle_step}


def mounted(x, y, yaw, **other):
    return URG.model_copy(update={"mount": (x, y, yaw), **other})


BAGS = {
    "transforms alone": (Recipe(), "odometry /tf"),
    "transforms and odometry": (Recipe(odometry={"/odom": "base_footprint"}), "odometry /odom"),
    "several odometries": (
        Recipe(tf_odometry=None, odometry={"/a/odometry": "base_link", "/z/odom": "base_link"}),
        "odometry /z/odom",
    ),
    "ROS 1, static ones in /tf": (Recipe(republished=True, ros1=True), "/tf: base_footprint"),
    "backward": (
        Recipe(static=BACKWARD, lasers=[Laser(mounted(0.1, 0, math.pi))]),
        "mount [0.100 m, 0.000 m, 180.0 deg], /tf_static: base_footprint -> laser",
    ),
    "upside down": (
        Recipe(static=DOWN, lasers=[Laser(mounted(0.1, 0.05, 0.3, **CLOCKWISE), upside_down=True)]),
        "mount [0.100 m, 0.050 m, 17.2 deg], upside down",
    ),
    "no largest range": (Recipe(lasers=[Laser(range_max=math.inf)]), "scan /scan"),
    "simulated time": (Recipe(start=0.0, clock=True), "odometry /tf"),
    "two lidars": (
        Recipe(
            static=TWO,
            lasers=[
                Laser(mounted(0.15, 0, 0), "/front/scan", "front"),
                Laser(mounted(-0.15, 0, math.pi), "/rear/scan", "rear"),
            ],
        ),
        "scan /front/scan (mount [0.150 m",
    ),
    "lidar alone": (Recipe(tf_odometry=None), "no odometry: mapped by the lidar alone"),
    "several echoes": (Recipe(lasers=[Laser(echoes=True)]), "scan /scan"),
    "compressed": (
        Recipe(compression=CompressionMode.FILE, plugin=StoragePlugin.SQLITE3),
        "scan /scan",
    ),
}


@pytest.fixture(scope="module")
def room():
    """A room, and some metres of a way in it."""
    return load_world("room")


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_is_mapped_as_it_is(name, room, tmp_path):
    recipe, said = BAGS[name]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    assert said in choices(*open_log(log))
    assert worst(impslam.run(log).path(), truth) < 0.01


def worst(path, truth):
    """Return the largest distance from the truth in m; both begin at their first scan."""
    assert len(path) == len(truth)
    np.testing.assert_allclose(path[:, 0], truth[:, 0], atol=1e-6)
    found, true = (
        between(np.broadcast_to(p[0, 1:4], (len(p), 3)), p[:, 1:4]) for p in (path, truth)
    )
    return np.hypot(*(found - true)[:, :2].T).max()


def test_without_the_mount_a_bag_is_mapped_wrongly(room, tmp_path):
    """What the tests above rest on."""
    recipe = BAGS["backward"][0]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    assert worst(impslam.run(log, settings=["sensors.lidar.mount=[0,0,0]"]).path(), truth) > 0.1


def test_a_second_lidar_is_added_by_what_the_line_says(room, tmp_path):
    recipe = BAGS["two lidars"][0]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    said = "--set sensors.NAME.kind=lidar2d --set sensors.NAME.stream=/rear/scan"
    assert f"/rear/scan is another lidar, added by {said}" in choices(*open_log(log))
    settings = ["sensors.rear.kind=lidar2d", "sensors.rear.stream=/rear/scan"]
    assert "/rear/scan (mount [-0.150 m, 0.000 m, 180.0 deg]" in choices(
        *open_log(log, None, settings)
    )
    both = impslam.run(log, settings=settings)
    assert len(both.path()) == 2 * len(truth)
    assert worst(both.path()[::2], truth) < 0.01


def test_a_folder_of_several_pieces_is_one_log(room, tmp_path):
    recipe = Recipe()
    entries, truth = drive(room, recipe)
    middle = len(entries) // 2
    log = write(tmp_path / "bag", recipe, entries[:middle])
    rest = write(tmp_path / "rest", recipe, entries[middle:])
    shutil.move(rest / "rest.mcap", log / "rest.mcap")
    text = (log / "metadata.yaml").read_text()
    (log / "metadata.yaml").write_text(text.replace("- bag.mcap", "- bag.mcap\n  - rest.mcap"))
    assert worst(impslam.run(log).path(), truth) < 0.01
