"""Scan matching: the motion between scans, from odometry and the scans themselves."""
