"""The robot computer: devices to log, map and page; drive commands back."""
