"""Lifecycles: add landmarks to the map, and remove them."""
