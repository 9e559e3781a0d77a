"""When a landmark enters the map, and when it leaves."""
