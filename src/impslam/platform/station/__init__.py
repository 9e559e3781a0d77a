"""The station: devices to log, map and page; drive commands back."""
