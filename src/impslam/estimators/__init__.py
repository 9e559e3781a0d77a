"""Estimators: where keyframes are, and what else is in the world."""
