"""Devices: what the robot's hardware says, as stamped messages on the host's time base."""
