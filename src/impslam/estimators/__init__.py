"""Estimators of keyframe poses and of the map."""
