"""Exteroceptive sensors: a message to a scan and observations."""
