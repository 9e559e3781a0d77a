"""Messages to increments of motion with covariance."""
