"""Occupancy grid and map files."""
