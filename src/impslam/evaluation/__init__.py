"""Estimates against the truth: trajectories, landmarks, tables and plots."""
