"""Scan to observations."""
