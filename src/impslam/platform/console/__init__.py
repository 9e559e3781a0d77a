"""The page that the robot serves, and who may use it."""
