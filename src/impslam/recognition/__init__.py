"""Place recognition: search for the pose of scans in a map, and verification by free space."""
