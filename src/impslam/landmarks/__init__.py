"""Landmark models: predict, initialise, retract, and how they are reported."""
