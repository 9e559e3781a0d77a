"""Places seen before: found by search, and verified by what the scans contradict."""
