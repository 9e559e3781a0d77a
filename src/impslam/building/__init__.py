"""Landmarks of a building whose keyframes' poses are known."""
