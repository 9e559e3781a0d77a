"""Devices: drivers of the robot's hardware, which deliver messages stamped on the host's time base."""
