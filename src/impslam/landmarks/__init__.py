"""Landmark models: predict, initialise, retract, and report landmarks."""
