"""Simulates logs: worlds, driving, ray casting and sensor noise."""
