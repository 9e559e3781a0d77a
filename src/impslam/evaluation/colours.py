"""What colour everything is drawn in, in every picture."""

INK, PALE = "#37424d", "#8a949e"
PATH, ODOMETRY, TRUTH, WALL, POINT = "#d81b60", "#f2a03d", "#15803d", "#2563eb", "#7c3aed"
FREE, SEEN, UNSEEN = "#ffffff", "#7d8892", "#eceef1"
"""Cells of the grid: free, occupied, and those that nobody has seen."""
SIGMAS = 3.0
"""How many standard deviations an ellipse shows."""
