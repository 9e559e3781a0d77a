"""Pose graph optimisation: pure functions from edges to poses and their covariances."""
