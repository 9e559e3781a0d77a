"""Trackers: estimate motion from keyframe to keyframe, from odometry and scans."""
