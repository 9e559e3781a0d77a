"""The pose graph: a pure function from constraints to poses and their covariances."""
