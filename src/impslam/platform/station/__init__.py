"""The station: connects devices, recorder, live map and page, and drives the robot."""
