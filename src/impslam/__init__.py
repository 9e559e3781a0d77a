"""impslam: EKF SLAM for small wheeled robots with a 2D lidar."""

from importlib.metadata import version

__version__ = version("impslam")
