"""Pure functions on float64 arrays: angles, SE(2), lines, circles."""
