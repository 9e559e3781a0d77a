"""Worlds, ray casting, driving and noise: what the robot would have recorded."""
