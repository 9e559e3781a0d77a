"""The robot's web page and its access control."""
