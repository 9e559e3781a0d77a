"""Calibration of wheels and lidar from logs."""
