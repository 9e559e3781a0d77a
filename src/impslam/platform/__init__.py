"""The robot computer: devices, the station that records and maps, its web console, and a virtual robot."""
