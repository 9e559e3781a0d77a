"""Colours of all figures."""

INK, PALE = "#37424d", "#8a949e"
PATH, ODOMETRY, TRUTH, WALL, POINT = "#d81b60", "#f2a03d", "#15803d", "#2563eb", "#7c3aed"
SCAN = "#e8590c"
FREE, SEEN, UNSEEN = "#ffffff", "#7d8892", "#eceef1"
"""Cells of the grid: free, occupied, and unobserved."""
SIGMAS = 3.0
"""Size of ellipses in standard deviations."""
