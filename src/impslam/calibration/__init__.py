"""From tracks to parameters: how a robot's wheels and laser differ from what its config says."""
