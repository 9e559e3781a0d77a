"""Where messages come from: log readers, the simulator, live drivers."""
