"""Trackers: the robot's motion from keyframe to keyframe, from odometry and scans."""
