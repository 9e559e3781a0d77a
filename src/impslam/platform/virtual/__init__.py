"""The virtual robot: emulators that speak the devices' own bytes, moved by the simulator."""
