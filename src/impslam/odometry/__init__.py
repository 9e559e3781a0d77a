"""Odometry: messages to increments of motion with covariance."""
