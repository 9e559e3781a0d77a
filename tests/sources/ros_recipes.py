"""Bags in the manner of slam_toolbox's users, and what `imp run` says of each."""

import math

from rosbags.rosbag2 import CompressionMode, StoragePlugin
from tests.sources.ros_robots import URDF, Laser, Recipe

from impslam.simulation.robot import Lidar

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
    "ROS 1, static ones in /tf": (
        Recipe(republished=True, ros1=True, tf_type="tf/msg/tfMessage"),
        "/tf: base_footprint",
    ),
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
    "simulated time without clock": (Recipe(start=0.0, ros1=True), "odometry /tf"),
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
