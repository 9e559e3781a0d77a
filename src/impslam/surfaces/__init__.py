"""Surfaces for aligning scans: points with normals, and maps of them."""
