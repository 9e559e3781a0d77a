"""Sources of messages: log readers and writers."""
