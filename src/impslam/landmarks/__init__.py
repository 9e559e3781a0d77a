"""Landmark models: predict, initialise, perturb and report landmarks."""
